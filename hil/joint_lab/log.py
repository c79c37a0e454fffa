"""What a bus's candump log tells of one drive: its reports, and its commands with the interrupts at which they act."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import can
import numpy as np

from bus import messages
from bus.messages import Statusword
from hil.errors import EmulationError


class Exchange(NamedTuple):
    """Commands and reports of one drive, in time. A report is of the interrupt at which it was sampled.

    The drive's interrupts are numbered from its power-on; n reports, m commands.
    """

    report_ticks: np.ndarray  # (n,) interrupts
    statuswords: np.ndarray  # (n,)
    positions: np.ndarray  # (n,) rad
    torques: np.ndarray  # (n,) N m, sensed
    currents: np.ndarray  # (n,) A
    command_ticks: np.ndarray  # (m,) interrupts from which each acts
    commanded: np.ndarray  # (m,) N m

    @property
    def limited(self) -> np.ndarray:
        """Which reports say that an internal limit was active, (n,)."""
        return (self.statuswords & Statusword.LIMITED) > 0


def read(path: Path, node_id: int, slot: int, rate: int, ticks_per_report: int) -> Exchange:
    """The exchange between a master and a drive that the log at ``path`` holds.

    Args:
        node_id: of the drive. slot: its slot in the commands.
        rate: interrupts of the drive per second.
        ticks_per_report: interrupts per report.

    Raises EmulationError where the drive's own word, which command it obeys, is not what the times on the bus tell.
    """
    reports, commands = [], []
    with can.CanutilsLogReader(path) as reader:
        for message in reader:
            time_ns, data = round(message.timestamp * 1e9), bytes(message.data)
            if message.arbitration_id == messages.STATE + node_id:
                state = messages.decode_state(data)
                latest = (time_ns + 1) * rate // 10**9 // ticks_per_report
                number = latest - (latest - state.counter & 0xFFFF)
                reports.append((number * ticks_per_report, state))
            elif message.arbitration_id == messages.COMMAND:
                tick = -(-time_ns * rate // 10**9)  # the first interrupt at or after its arrival
                setpoint = messages.decode_setpoint(data, slot)
                commands.append((tick, messages.command_counter(data), setpoint.torque))
    exchange = Exchange(
        np.array([tick for tick, _ in reports]),
        np.array([state.statusword for _, state in reports]),
        np.array([state.position for _, state in reports]),
        np.array([state.torque for _, state in reports]),
        np.array([state.current for _, state in reports]),
        np.array([tick for tick, *_ in commands]),
        np.array([torque for *_, torque in commands]),
    )
    counters = np.array([0, *(counter for _, counter, _ in commands)])
    obeyed = counters[np.searchsorted(exchange.command_ticks, exchange.report_ticks, side="right")]
    told = np.array([state.command_counter for _, state in reports])
    wrong = np.flatnonzero(obeyed != told)
    if len(wrong):
        at = wrong[0]
        raise EmulationError(
            f"{path}: at interrupt {exchange.report_ticks[at]} the drive obeys command {told[at]}, where command "
            f"{obeyed[at]} was the last on the bus"
        )
    return exchange


class Pairs(NamedTuple):
    """Commands and reports side by side, one pair per report: the command acts ``offset`` interrupts after it."""

    rate: float  # pairs per second
    offset: int
    commanded: np.ndarray  # (n,) N m
    torques: np.ndarray  # (n,) N m, sensed
    currents: np.ndarray  # (n,) A


def pairs(exchange: Exchange, rate: int, ticks_per_report: int) -> Pairs:
    """Pair each report with the command that begins to act before the next one.

    Raises EmulationError unless there is exactly one, always the same number of interrupts later.
    """
    first, last = exchange.command_ticks[0], exchange.command_ticks[-1]
    chosen = (exchange.report_ticks > first) & (exchange.report_ticks <= last - ticks_per_report)
    ticks = exchange.report_ticks[chosen]
    at = np.searchsorted(exchange.command_ticks, ticks, side="left")
    offsets = exchange.command_ticks[at] - ticks
    if not len(offsets) or np.any(offsets != offsets[0]) or offsets[0] >= ticks_per_report or np.any(np.diff(at) != 1):
        raise EmulationError(
            "the master's commands do not keep step with the drive's reports: their rates differ, or the bus does not "
            "carry so many; a lower firmware.report_rate may do"
        )
    return Pairs(
        rate / ticks_per_report, int(offsets[0]), exchange.commanded[at], exchange.torques[chosen],
        exchange.currents[chosen],
    )  # fmt: skip
