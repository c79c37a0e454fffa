"""The calendar: one ordering of all events of a run, for any backend and either clock.

Events are ordered by time in integer nanoseconds and, at the same time, by the fixed order in ``System._step``:
wires, links, world and joints, controller's tick, controller's answer. Nothing is ordered by arrival, so a run is
the same on every backend and on a loaded machine.

At the joints' tick k the order is: read the sensors, apply the outputs of tick k − 1 (a DSP's output takes effect at
its next PWM period), let the joints compute, and meanwhile step the physics to tick k + 1.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from bus import messages
from bus.frames import ErrorFrame, Frame
from bus.gateway import Gateway
from bus.link import NEVER, Link
from bus.wire import Wire
from bus.zenoh_link import IMU_SOURCE
from hil.clock import VirtualClock, WallClock, tick_ns
from hil.faults import Faults
from hil.injection import Injector
from hil.record.journal import Journal, frame_entry
from hil.record.recorder import Recorder
from hil.record.ring import StepRing
from hil.scenario import Scenario
from hil.streams import StreamFactory
from robots.description import Robot

if TYPE_CHECKING:  # a backend forks its children before the physics is imported
    from hil.analysis.verdict import Monitor
    from plant.world import World

GATEWAY_PORT = 0  # joints follow, then who only disturbs, and last the port of attached tools
_FLUSH_NS = 100_000_000
_MONITOR_NS = 10_000_000

Item = tuple[int, int, bytes]  # source or bus, CAN identifier, payload


class JointHost(Protocol):
    """Runs the joint nodes of a tick, all but those in ``idle``: ``start`` may return before they are done,
    ``finish`` waits."""

    def start(self, now_ns: int, inboxes: list[list[Frame]], idle: Sequence[int] = ()) -> None: ...
    def finish(self) -> list[list[Frame]]: ...
    def snapshot(self) -> list[Any]: ...
    def restore(self, states: list[Any]) -> None: ...


class ControllerHost(Protocol):
    """Runs the controller node: ``start`` hands over what arrived, ``finish`` returns commands and telemetry."""

    def start(self, now_ns: int, items: list[tuple[int, int, int, bytes]]) -> None: ...
    def finish(self) -> tuple[list[Item], np.ndarray]: ...
    def snapshot(self) -> Any: ...
    def restore(self, state: Any) -> None: ...


class Tap(Protocol):
    """Tools attached to the buses from outside: they see every frame and may send."""

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None: ...
    def broadcast_error(self, bus: int, time_ns: int, sender: int, error: ErrorFrame) -> None: ...
    def set_state(self, bus: int, tec: int, rec: int, state: int) -> None: ...
    def poll(self) -> list[tuple[int, Frame]]: ...
    def refused(self, bus: int, frame: Frame) -> None: ...


class System:
    """All nodes of a run and the calendar that drives them."""

    def __init__(
        self,
        scenario: Scenario,
        robot: Robot,
        world: World,
        joints: JointHost,
        controller: ControllerHost,
        recorder: Recorder,
        streams: StreamFactory,
        clock: VirtualClock | WallClock,
        monitor: Monitor | None = None,
        journal: Journal | None = None,
    ) -> None:
        self.scenario = scenario
        self.world, self.joints, self.controller = world, joints, controller
        self.recorder, self.clock, self.monitor = recorder, clock, monitor
        self.now_ns = 0
        self.stop_reason: str | None = None  # set by the monitor
        self.tap: Tap | None = None
        self.ring: StepRing | None = None
        self.requests: deque[Callable[[], None]] = deque()  # run between two events: injections while running
        self.journal = journal if journal is not None else Journal(None)
        self.tool_frames = 0

        self._joint_count = len(robot.joints)
        self.wires = [
            Wire(bus.name, scenario.bus[bus.name], len(bus.joints) + 2 + Faults.PORTS, streams)
            for bus in robot.buses
        ]
        self._tool_port = [wire.ports - 1 for wire in self.wires]
        order = {name: index for index, name in enumerate(robot.joint_names)}
        self._joints_of = [[order[name] for name in bus.joints] for bus in robot.buses]
        self._place = {
            order[name]: (b, port)
            for b, bus in enumerate(robot.buses)
            for port, name in enumerate(bus.joints, start=GATEWAY_PORT + 1)
        }
        self._accepts = [self._acceptance(robot, b) for b in range(len(robot.buses))]
        self.gateway = Gateway(robot)
        self.state_link = Link("link.state", scenario.link.state, streams)
        self.command_link = Link("link.command", scenario.link.command, streams)

        self._isr_rate = int(scenario.firmware.rate)
        self._steps_per_isr = int(scenario.world.rate) // self._isr_rate
        self._isr_per_report = self._isr_rate // int(scenario.firmware.report_rate)
        self._control_rate = int(scenario.controller.rate)
        self._control_phase_ns = round(scenario.controller.phase * 1e9)
        self._compute_ns = round(scenario.controller.compute_time * 1e9)
        self._isr = 0  # ticks done
        self._control = 0
        self._isr_ns = 0
        self._control_ns = self._control_phase_ns
        self._reply_ns = NEVER
        self._reply: tuple[list[Item], np.ndarray] | None = None
        self._flush_ns = _FLUSH_NS
        self._monitor_ns = _MONITOR_NS
        self._inboxes: list[list[Frame]] = [[] for _ in range(self._joint_count)]
        self._arrived: list[tuple[int, int, int, bytes]] = []
        self.faults = Faults(scenario, robot, self.wires, self._place, world.faults, streams, lambda: self._isr)
        self._senders = self.faults.senders
        links = {"link.state": self.state_link, "link.command": self.command_link}
        self.injector = Injector(scenario, robot, self.faults.setters(links), self.journal)

        self._world_rows = recorder.channel("world")
        self._controller_rows = recorder.channel("controller")
        self._drive_rows = recorder.channel("drives")
        self._bus_rows = recorder.channel("bus")
        n = self._joint_count
        self._drive_row = np.full(3 * n, np.nan)
        self._drive_row[: 2 * n] = 0.0
        self._bus_row = np.zeros(4 * len(self.wires))
        self._busy_before = [0] * len(self.wires)
        names = self._controller_rows.signals
        self._com_columns = [names.index(n) for n in ("com.x", "com.z", "com_reference.x", "com_reference.z")]
        self._com_error = 0.0

    def _acceptance(self, robot: Robot, b: int) -> dict[int, list[tuple[int, int]]]:
        """The acceptance filters of a bus's drives: port and joint of those that receive an identifier."""
        accepts: dict[int, list[tuple[int, int]]] = {}
        for port, joint in enumerate(self._joints_of[b], start=GATEWAY_PORT + 1):
            for identifier in messages.accepted(robot.joints[joint].node_id):
                accepts.setdefault(identifier, []).append((port, joint))
        return accepts

    # --- running ------------------------------------------------------------------------------------------------

    def run_until(self, end_ns: int) -> None:
        """Process all events before ``end_ns``, in order; return early when the monitor has seen a reason to stop."""
        while self.stop_reason is None:
            now = min(
                self._isr_ns,
                self._control_ns,
                self._reply_ns,
                self.faults.next_ns,
                self.state_link.next_time(),
                self.command_link.next_time(),
                *[wire.next_time() for wire in self.wires],
            )
            if now >= end_ns:
                self.now_ns = end_ns
                return
            self.now_ns = now
            self._step(now)

    def _step(self, now: int) -> None:
        if now == self.faults.next_ns:
            self.faults.advance(now)
        for b, wire in enumerate(self.wires):
            if wire.next_time() == now:
                for delivery in wire.advance(now):
                    self._deliver(b, now, delivery.sender, delivery.frame, delivery.missed)
                for at, port, error in wire.error_frames():
                    self._note_error(b, at, port, error)
        if self.state_link.next_time() == now:
            for arrival, (source, can_id, data) in self.state_link.pop_due(now):
                self._arrived.append((arrival, source, can_id, data))
        if self.command_link.next_time() == now:
            for _, item in self.command_link.pop_due(now):
                with contextlib.suppress(messages.MalformedMessageError):  # the gateway has counted it
                    bus, frame = self.gateway.from_link(item)
                    if self.faults.commands:
                        frame = self.faults.commands.apply(bus, frame)
                    self.wires[bus].offer(now, GATEWAY_PORT, frame)
        if now == self._isr_ns:
            self.clock.wait_until(now)
            self._tick_joints(now)
        if now == self._reply_ns:
            self._finish_control(now)
        if now == self._control_ns:
            self._start_control(now)

    def _deliver(self, b: int, now: int, sender: int, frame: Frame, missed: int) -> None:
        """``missed``: bit mask of the ports that a fault keeps the frame from."""
        self.recorder.frame(now, b, frame)
        if self.tap is not None and not missed >> self._tool_port[b] & 1:
            self.tap.broadcast(b, now, sender, frame)
        sound = type(frame.data) is bytes  # what a corrupted frame says is no fact about the run
        receivers = self._accepts[b].get(frame.id)
        if receivers is not None and not frame.extended and not frame.remote:
            for port, joint in receivers:
                if sender != port and not missed >> port & 1:
                    self._inboxes[joint].append(frame)
            if sender == GATEWAY_PORT and sound:  # which sends commands alone
                for slot, joint in enumerate(self._joints_of[b]):
                    if not missed >> slot + 1 & 1:
                        self._note_round_trip(now, joint, slot, frame.data)
        if sender != GATEWAY_PORT and not missed >> GATEWAY_PORT & 1:
            item = self.gateway.from_can(now, b, frame)
            if item is not None:
                self.state_link.send(now, item, 8 * len(frame.data))
                if frame.id & 0x780 == messages.STATE and sound:
                    self._note_state(b, sender, frame.data)

    def _note_error(self, b: int, now: int, port: int, error: ErrorFrame) -> None:
        """What the tools' controller tells of an error on the bus; other nodes hear it from their own."""
        if port == self._tool_port[b]:
            self.recorder.frame(now, b, error)
            if self.tap is not None:
                self.tap.broadcast_error(b, now, port, error)

    def _tick_joints(self, now: int) -> None:
        world = self.world
        if self._isr % self._isr_per_report == 0:
            self._world_rows.append(now, world.truth())
            self.state_link.send(now, (IMU_SOURCE, 0, world.imu()), 8 * 12)
        world.sample()
        world.latch()
        if self._senders.clocks:
            self._tick_on_own_clocks(now)
        else:
            self.joints.start(now, self._inboxes)
            self._step_physics()
            self._senders.offer(now, self.joints.finish())
            for inbox in self._inboxes:
                inbox.clear()
        self._isr += 1
        self._isr_ns = tick_ns(self._isr, self._isr_rate)

    def _step_physics(self) -> None:
        world, ring = self.world, self.ring
        for _ in range(self._steps_per_isr):
            world.step()
            if ring is not None:
                ring.append()

    def _tick_on_own_clocks(self, now: int) -> None:
        """The same where clocks drift: a joint may tick once, twice or not at all within this tick of the world."""
        senders, inboxes = self._senders, self._inboxes
        offsets = senders.offsets(now)
        idle = [joint for joint, times in offsets.items() if not times]
        self.joints.start(now, [[] if j in idle else inbox for j, inbox in enumerate(inboxes)], idle)
        self._step_physics()
        senders.offer(now, self.joints.finish(), offsets)
        for joint, inbox in enumerate(inboxes):
            if joint not in idle:
                inbox.clear()
        again = [joint for joint, times in offsets.items() if len(times) > 1]
        if again:
            self.joints.start(now, [[] for _ in inboxes], [j for j in range(self._joint_count) if j not in again])
            senders.offer(now, self.joints.finish(), offsets, tick=1)
        self.faults.look()

    def _start_control(self, now: int) -> None:
        self.injector.apply_due(now)
        while self.requests:  # filled by a thread of Zenoh's
            self.requests.popleft()()
        if self.tap is not None:
            for b, wire in enumerate(self.wires):
                self.tap.set_state(b, *wire.ports_state(self._tool_port[b]))
            for bus, frame in self.tap.poll():
                self._offer_of_tool(now, bus, frame)
        self.controller.start(now, self._arrived)
        self._arrived = []
        self._reply_ns = now + self._compute_ns
        self._control += 1
        self._control_ns = self._control_phase_ns + tick_ns(self._control, self._control_rate)
        self._drive_rows.append(now, self._drive_row)
        self._drive_row[2 * self._joint_count :] = np.nan

    def _offer_of_tool(self, now: int, bus: int, frame: Frame) -> bool:
        wire, port = self.wires[bus], self._tool_port[bus]
        self.tool_frames += 1
        self.journal.write(frame_entry(now, wire.name, port, frame))
        taken = wire.offer(now, port, frame)
        if not taken and self.tap is not None:
            self.tap.refused(bus, frame)
        return taken

    def _finish_control(self, now: int) -> None:
        commands, telemetry = self._reply if self._reply is not None else self.controller.finish()
        self._reply = None
        self._reply_ns = NEVER
        for item in commands:
            self.command_link.send(now, item, 8 * len(item[2]))
        self._controller_rows.append(now, telemetry)
        if now >= self._monitor_ns:
            self._watch(now, telemetry)
        if now >= self._flush_ns:
            self._flush_ns += _FLUSH_NS
            self.recorder.flush(now)
            if self.journal.is_open:
                self.journal.write({"time_ns": now, "digest": self.recorder.digest()})

    # --- observing ----------------------------------------------------------------------------------------------

    def _note_state(self, b: int, sender: int, data: bytes) -> None:
        joint = self._joints_of[b][sender - 1] if 0 < sender <= len(self._joints_of[b]) else None
        if joint is not None and len(data) == messages.STATE_LENGTH:
            self._drive_row[joint] = data[2] | data[3] << 8
            self._drive_row[self._joint_count + joint] = data[22]

    def _note_round_trip(self, now: int, joint: int, slot: int, data: bytes) -> None:
        """Time from the joint's sample to the command that used it arriving at that joint.

        Sample c is taken at the joint's report tick c; the command echoes c modulo 2**16.
        """
        if len(data) != messages.COMMAND_LENGTH:
            return
        controlword, echoed = data[4 + 20 * slot], data[22 + 20 * slot] | data[23 + 20 * slot] << 8
        if controlword != messages.Controlword.ENABLE_OPERATION:
            return  # not yet computed from a sample
        if joint in self._senders.clocks:
            own = self._senders.clocks[joint].sampled_ns(echoed, self._isr_per_report)
            if own is not None:
                self._drive_row[2 * self._joint_count + joint] = (now - own) * 1e-9
            return
        latest = (self._isr - 1) // self._isr_per_report
        sample = latest - ((latest - echoed) & 0xFFFF)
        if sample >= 0:
            sampled = tick_ns(sample * self._isr_per_report, self._isr_rate)
            self._drive_row[2 * self._joint_count + joint] = (now - sampled) * 1e-9

    def _watch(self, now: int, telemetry: np.ndarray) -> None:
        span = now - self._monitor_ns + _MONITOR_NS
        self._monitor_ns = now + _MONITOR_NS
        count = len(self.wires)
        for b, wire in enumerate(self.wires):
            self._bus_row[b] = (wire.busy_ns - self._busy_before[b]) / span
            self._busy_before[b] = wire.busy_ns
            self._bus_row[count + b] = wire.sent
            self._bus_row[2 * count + b] = wire.lost
            self._bus_row[3 * count + b] = wire.errors
        self._bus_rows.append(now, self._bus_row)
        x, z, x_reference, z_reference = telemetry[self._com_columns]
        self._com_error = float(np.hypot(x - x_reference, z - z_reference))
        if self.monitor is not None:
            self.stop_reason = self.monitor.check(now, self.world.truth(), telemetry, self._drive_row)

    def deliveries(self) -> dict[str, dict[str, int]]:
        """What has happened so far to what buses and links carried, by their paths."""
        links = {"link.state": self.state_link, "link.command": self.command_link}
        return {path: link.counts for path, link in links.items()} | {
            f"bus.{wire.name}": wire.counts for wire in self.wires
        }

    def com_error(self) -> float:
        """Distance of the estimated CoM from its reference in the sagittal plane now, m."""
        return self._com_error

    def bus_loads(self) -> list[float]:
        """Load of each bus over the last hundredth of a second."""
        return [float(share) for share in self._bus_row[: len(self.wires)]]

    # --- injecting ----------------------------------------------------------------------------------------------

    @property
    def injected(self) -> list[dict[str, Any]]:
        """Every change so far, with its time."""
        return self.injector.injected

    @property
    def reproducible_from(self) -> str:
        """What repeats this run to the bit: "scenario" (and seed), or "record" when something came from outside."""
        return "record" if self.tool_frames or self.injector.from_outside else "scenario"

    def inject(self, key: str, value: Any) -> Any:
        """Change one injectable value from now on, at a request from outside. Returns it in SI units; raises UserError
        for a wrong one."""
        return self.injector.inject(self.now_ns, key, value)

    # --- state --------------------------------------------------------------------------------------------------

    _PLAIN = (
        "now_ns", "_isr", "_control", "_isr_ns", "_control_ns", "_reply_ns", "_flush_ns", "_monitor_ns", "tool_frames",
        "stop_reason",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """The whole system between two events; an answer of the controller that is under way is waited for."""
        if self._reply_ns != NEVER and self._reply is None:
            self._reply = self.controller.finish()
        reply = None if self._reply is None else ([tuple(i) for i in self._reply[0]], self._reply[1].copy())
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            "reply": reply,
            "inboxes": [list(inbox) for inbox in self._inboxes],
            "arrived": list(self._arrived),
            "drive_row": self._drive_row.copy(),
            "busy_before": list(self._busy_before),
            "world": self.world.snapshot(),
            "joints": self.joints.snapshot(),
            "controller": self.controller.snapshot(),
            "wires": [wire.snapshot() for wire in self.wires],
            "links": [self.state_link.snapshot(), self.command_link.snapshot()],
            "gateway": self.gateway.snapshot(),
            "faults": self.faults.snapshot(),
            "injector": self.injector.snapshot(),
            "monitor": None if self.monitor is None else self.monitor.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``snapshot``: the run goes on as the uninterrupted one did."""
        for name in self._PLAIN:
            setattr(self, name, state[name])
        reply = state["reply"]
        self._reply = None if reply is None else (list(reply[0]), reply[1].copy())
        self._inboxes = [list(inbox) for inbox in state["inboxes"]]
        self._arrived = list(state["arrived"])
        self._drive_row[:] = state["drive_row"]
        self._busy_before = list(state["busy_before"])
        self.world.restore(state["world"])
        self.joints.restore(state["joints"])
        self.controller.restore(state["controller"])
        for wire, saved in zip(self.wires, state["wires"], strict=True):
            wire.restore(saved)
        self.state_link.restore(state["links"][0])
        self.command_link.restore(state["links"][1])
        self.gateway.restore(state["gateway"])
        self.faults.restore(state["faults"])
        self.injector.restore(state["injector"])
        if self.ring is not None:
            self.ring.clear()
        if self.monitor is not None:
            self.monitor.restore(state["monitor"])


