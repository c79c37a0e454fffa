"""What a scenario sends on its buses, and how long each frame takes at worst: nothing is run for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bus import messages
from bus.config import BusConfig
from bus.frames import BASE_ID_LIMIT
from bus.response_time import Message, Response, longest_frame, longest_frame_ns, response_times, utilisation
from bus.timing import INTERMISSION, BitRates
from bus.wire import QUEUE, Wire
from hil.clock import tick_ns
from hil.scenario import Scenario
from hil.streams import streams
from robots import description
from robots.description import Bus, Robot

_SECOND = 10**9


@dataclass(frozen=True)
class Traffic:
    """A kind of frame on a bus. Times in ns.

    offset: of the first release on the drives' clock; None: at any time (sporadic). fd: CAN FD with bit-rate switch,
    as all frames of gateway and drives are; otherwise a classical frame.
    """

    name: str
    identifier: int
    length: int
    period: int
    jitter: int = 0
    deadline: int | None = None
    offset: int | None = 0
    fd: bool = True

    @property
    def extended(self) -> bool:
        return self.identifier >= BASE_ID_LIMIT

    def message(self, rates: BitRates) -> Message:
        """As the analysis takes it."""
        base = self.identifier if not self.extended else self.identifier >> 18
        order = base << 20 | (1 << 19 | self.identifier & 0x3FFFF if self.extended else 0)  # of a base frame: first
        frame = longest_frame_ns(self.identifier, self.length, rates, self.fd, self.fd, self.extended)
        return Message(self.name, order, frame, self.period, self.jitter, self.deadline)


def traffic(scenario: Scenario, robot: Robot, bus: Bus) -> list[Traffic]:
    """What the gateway and the drives send on ``bus``, by identifier.

    A command or state has to arrive before the next one is sent. A drive sends its emergencies at least the
    watchdog's time apart: a fault is sent once, and nothing resets it sooner.
    """
    firmware, controller, link = scenario.firmware, scenario.controller, scenario.link.command
    rate, per_report = int(firmware.rate), round(firmware.rate / firmware.report_rate)
    ticks = max(round(firmware.heartbeat_period * rate), per_report)
    ticks += -ticks % per_report  # heartbeats keep to ticks without a report
    slot = 1 if per_report > 1 else 0
    watchdog = round(firmware.watchdog * _SECOND)
    sent = controller.phase + controller.compute_time + link.delay
    found = [
        Traffic(
            "command", messages.COMMAND, messages.COMMAND_LENGTH, tick_ns(1, int(controller.rate)),
            jitter=round(link.jitter * _SECOND), offset=round(sent * _SECOND),
        )
    ]  # fmt: skip
    for joint in robot.joints_of(bus):
        node, beat = joint.node_id, (slot + per_report * joint.node_id) % ticks
        state, heartbeat = tick_ns(per_report, rate), tick_ns(ticks, rate)
        found += [
            Traffic(f"{joint.name} state", messages.STATE + node, messages.STATE_LENGTH, state),
            Traffic(
                f"{joint.name} emergency", messages.EMERGENCY + node, messages.EMERGENCY_LENGTH, watchdog, offset=None
            ),
        ]
        if firmware.heartbeat_period:
            offset = tick_ns(beat, rate)
            found.append(Traffic(f"{joint.name} heartbeat", messages.HEARTBEAT + node, 1, heartbeat, offset=offset))
    return sorted(found, key=lambda t: t.identifier)


def analyse(sent: Sequence[Traffic], config: BusConfig, fault_interval: int | None = None) -> list[Response]:
    """Response times of ``sent`` on a bus of ``config``, by priority; ``fault_interval`` in ns."""
    rates = BitRates(config.arbitration_rate, config.data_rate)
    return response_times([t.message(rates) for t in sent], rates.ns(1), fault_interval)


def as_planned(sent: Sequence[Traffic], config: BusConfig) -> dict[str, int]:
    """Longest time from queueing to the end of the frame of each message, ns, when all frames are as long as they can
    be and sent at their offsets, without jitter: a second of it on a wire. Sporadic messages are left out."""
    clean = BusConfig().model_copy(update={key: getattr(config, key) for key in ("arbitration_rate", "data_rate")})
    planned = [t for t in sent if t.offset is not None]
    wire = Wire("planned", clean, max(2, len(planned)), streams(0))  # somebody acknowledges
    releases = sorted(
        (t.offset + k * t.period, port)
        for port, t in enumerate(planned)
        if t.offset is not None
        for k in range(-(-_SECOND // t.period))
    )
    frames = [longest_frame(t.identifier, t.length, extended=t.extended) for t in planned]
    waiting: list[list[int]] = [[] for _ in planned]
    longest = dict.fromkeys((t.name for t in planned), 0)
    intermission = BitRates(config.arbitration_rate, config.data_rate).ns(INTERMISSION)
    for at, port in [*releases, (2 * _SECOND, -1)]:
        while wire.next_ns < at:
            for delivery in wire.advance(wire.next_ns):
                name = planned[delivery.sender].name
                response = delivery.time + intermission - waiting[delivery.sender].pop(0)
                longest[name] = max(longest[name], response)
        if port >= 0 and len(waiting[port]) < QUEUE:
            wire.offer(at, port, frames[port])
            waiting[port].append(at)
    return longest


def load_table(scenario: Scenario, extra: Sequence[Traffic] = (), fault_interval: int | None = None) -> dict[str, Any]:
    """The whole table, ready for JSON; times in s, None where there is no bound."""
    robot = description.load(scenario.robot)
    buses = {}
    for bus in robot.buses:
        config = scenario.bus[bus.name]
        sent = [*traffic(scenario, robot, bus), *extra]
        kind = {t.name: t for t in sent}
        planned = as_planned(sent, config)
        responses = analyse(sent, config, fault_interval)
        rows = []
        for r in responses:
            t = kind[r.message.name]
            rows.append({
                "identifier": t.identifier,
                "name": t.name,
                "length": t.length,
                "period": t.period / _SECOND,
                "jitter": t.jitter / _SECOND,
                "offset": None if t.offset is None else t.offset / _SECOND,
                "frame": r.message.frame / _SECOND,
                "blocking": r.blocking / _SECOND,
                "planned": planned[t.name] / _SECOND if t.name in planned else None,
                "response": None if r.longest is None else r.longest / _SECOND,
                "deadline": r.deadline / _SECOND,
                "slack": None if r.slack is None else r.slack / _SECOND,
                "schedulable": r.schedulable,
            })  # fmt: skip
        buses[bus.name] = {
            "arbitration_rate": config.arbitration_rate,
            "data_rate": config.data_rate,
            "utilisation": utilisation([r.message for r in responses]),
            "schedulable": all(r.schedulable for r in responses),
            "messages": rows,
        }
    return {
        "scenario": scenario.name,
        "fault_interval": None if fault_interval is None else fault_interval / _SECOND,
        "schedulable": all(bus["schedulable"] for bus in buses.values()),
        "buses": buses,
    }
