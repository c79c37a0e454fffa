"""What the calendar notes of a run beside frames: the drives' states, round trips, the loads of the buses."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from bus import messages
from bus.wire import Wire
from hil.clock import tick_ns
from hil.record.recorder import Recorder
from hil.senders import Senders
from robots.description import Robot

_PERIOD_NS = 10_000_000  # of looking at the buses
_STATE = "2xH18xBx"  # statusword and error in a drive's state
_ENABLED = messages.Controlword.ENABLE_OPERATION


class Observer:
    """Keeps the rows of the channels "drives" and "bus".

    Args:
        joints_of: joints of each bus, in the order of their ports and of a command's slots.
        senders: know the joints that have clocks of their own.
        isr_rate: ticks of the joints per second, of which every ``isr_per_report``-th samples a state.
    """

    def __init__(
        self,
        robot: Robot,
        recorder: Recorder,
        joints_of: Sequence[Sequence[int]],
        senders: Senders,
        isr_rate: int,
        isr_per_report: int,
    ) -> None:
        self.next_ns = _PERIOD_NS  # when ``watch`` is due
        self._joints_of, self._senders = joints_of, senders
        self._isr_rate, self._isr_per_report = isr_rate, isr_per_report
        self._drive_rows = recorder.channel("drives")
        self._bus_rows = recorder.channel("bus")
        n, buses = len(robot.joints), len(robot.buses)
        self._n = n
        self._states = [bytes(messages.STATE_LENGTH)] * n  # the last of each drive
        self._unpack = struct.Struct("<" + n * _STATE).unpack
        self._row = np.full(3 * n, np.nan)  # statusword, error and round trip of each
        self._row_items: memoryview[float] = memoryview(self._row)  # type: ignore[arg-type, assignment]
        self._pack = partial(struct.Struct(f"{2 * n}d").pack_into, self._row.data, 0)
        self._bus_row = np.zeros(4 * buses)
        self._busy_before = [0] * buses
        names = recorder.channel("controller").signals
        self._com_columns = [names.index(n) for n in ("com.x", "com.z", "com_reference.x", "com_reference.z")]
        self._com_error = 0.0

    def note_state(self, b: int, sender: int, data: bytes) -> None:
        """A drive's state that the gateway has received."""
        joints = self._joints_of[b]
        if 0 < sender <= len(joints) and len(data) == messages.STATE_LENGTH:
            self._states[joints[sender - 1]] = data

    def note_command(self, b: int, now: int, isr: int, data: bytes, missed: int) -> None:
        """A command that the drives of a bus have received, all but those whose ports are in the bit mask ``missed``,
        after ``isr`` ticks of the joints: the time from a joint's sample to the command that used it.

        Sample c is taken at the joint's report tick c; the command echoes c modulo 2**16.
        """
        if len(data) != messages.COMMAND_LENGTH:
            return
        at = 4  # of the slot
        per_report, clocks = self._isr_per_report, self._senders.clocks
        latest = (isr - 1) // per_report
        for slot, joint in enumerate(self._joints_of[b]):
            if data[at] == _ENABLED and not missed >> slot + 1 & 1:  # else not yet computed from a sample
                echoed = data[at + 18] | data[at + 19] << 8
                if joint in clocks:
                    sampled: float | None = clocks[joint].sampled_ns(echoed, per_report)
                else:
                    sample = latest - ((latest - echoed) & 0xFFFF)
                    sampled = tick_ns(sample * per_report, self._isr_rate) if sample >= 0 else None
                if sampled is not None:
                    self._row_items[2 * self._n + joint] = (now - sampled) * 1e-9
            at += 20

    def note_drives(self, now: int) -> None:
        """The drives' row of this tick of the controller."""
        self._drive_rows.append(now, self.drive_row())
        self._row[2 * self._n :] = np.nan

    def drive_row(self) -> np.ndarray:
        """What is known of the drives now, as the channel has it; the array is reused."""
        fields = self._unpack(b"".join(self._states))
        self._pack(*fields[::2], *fields[1::2])
        return self._row

    def watch(self, now: int, wires: Sequence[Wire], telemetry: np.ndarray) -> None:
        """Note the loads of the buses since the last call, and the controller's error."""
        span = now - self.next_ns + _PERIOD_NS
        self.next_ns = now + _PERIOD_NS
        count = len(wires)
        for b, wire in enumerate(wires):
            self._bus_row[b] = (wire.busy_ns - self._busy_before[b]) / span
            self._busy_before[b] = wire.busy_ns
            self._bus_row[count + b] = wire.sent
            self._bus_row[2 * count + b] = wire.lost
            self._bus_row[3 * count + b] = wire.errors
        self._bus_rows.append(now, self._bus_row)
        x, z, x_reference, z_reference = telemetry[self._com_columns]
        self._com_error = float(np.hypot(x - x_reference, z - z_reference))

    def com_error(self) -> float:
        """Distance of the estimated CoM from its reference in the sagittal plane, at the last look, m."""
        return self._com_error

    def bus_loads(self) -> list[float]:
        """Load of each bus over the last hundredth of a second."""
        return [float(share) for share in self._bus_row[: len(self._busy_before)]]

    def snapshot(self) -> dict[str, Any]:
        return {
            "next_ns": self.next_ns,
            "states": list(self._states),
            "row": self._row.copy(),
            "busy_before": list(self._busy_before),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.next_ns = state["next_ns"]
        self._states = list(state["states"])
        self._row[:] = state["row"]
        self._busy_before = list(state["busy_before"])
