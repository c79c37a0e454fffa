"""The calendar: one ordering of all events of a run, for any backend and either clock.

Events are ordered by time in integer nanoseconds and, at the same time, by the fixed order in ``System.run_until``:
wires, links, motion capture, world and joints, controller's tick, controller's answer. Nothing is ordered by arrival,
so a run is the same on every backend and on a loaded machine.

At the joints' tick k the order is: read the sensors, apply the outputs of tick k − 1 (a DSP's output takes effect at
its next PWM period), let the joints compute, and meanwhile step the physics to tick k + 1.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from bus import messages
from bus.frames import ErrorFrame, Frame
from bus.gateway import Gateway
from bus.link import NEVER, Link
from bus.wire import Wire
from bus.zenoh_link import IMU_SOURCE, MOTION_CAPTURE_SOURCE
from hil.clock import VirtualClock, WallClock, tick_ns
from hil.faults import Faults
from hil.injection import Injector
from hil.observer import Observer
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
        self.motion_capture_link = Link("link.motion_capture", scenario.link.motion_capture, streams)
        self._links = {
            "link.state": self.state_link, "link.command": self.command_link,
            "link.motion_capture": self.motion_capture_link,
        }  # fmt: skip

        self._isr_rate = int(scenario.firmware.rate)
        self._steps_per_isr = int(scenario.world.rate) // self._isr_rate
        self._isr_per_report = self._isr_rate // int(scenario.firmware.report_rate)
        self._control_rate = int(scenario.controller.rate)
        self._control_phase_ns = round(scenario.controller.phase * 1e9)
        self._compute_ns = round(scenario.controller.compute_time * 1e9)
        self._exposure_rate = robot.motion_capture.rate if robot.motion_capture is not None else 0
        self._exposures = 0  # done
        self._exposure_ns = NEVER if world.motion_capture is None else 0
        self._isr = 0  # ticks done
        self._control = 0
        self._isr_ns = 0
        self._control_ns = self._control_phase_ns
        self._reply_ns = NEVER
        self._reply: tuple[list[Item], np.ndarray] | None = None
        self._flush_ns = _FLUSH_NS
        self._inboxes: list[list[Frame]] = [[] for _ in range(self._joint_count)]
        self._arrived: list[tuple[int, int, int, bytes]] = []
        self.faults = Faults(
            scenario, robot, self.wires, self._place, world.faults, streams, lambda: self._isr, world.motion_capture
        )
        self._senders = self.faults.senders
        self.injector = Injector(scenario, robot, self.faults.setters(self._links), self.journal)

        self.observer = Observer(
            robot, recorder, self._joints_of, self._senders, self._isr_rate, self._isr_per_report
        )
        self._world_rows = recorder.channel("world")
        self._controller_rows = recorder.channel("controller")
        self._motion_capture_rows = recorder.channel("motion_capture") if world.motion_capture is not None else None

    def _acceptance(self, robot: Robot, b: int) -> dict[int, list[tuple[int, int]]]:
        """The acceptance filters of a bus's drives: port and joint of those that receive an identifier."""
        accepts: dict[int, list[tuple[int, int]]] = {}
        for port, joint in enumerate(self._joints_of[b], start=GATEWAY_PORT + 1):
            for identifier in messages.accepted(robot.joints[joint].node_id):
                accepts.setdefault(identifier, []).append((port, joint))
        return accepts

    # --- running ------------------------------------------------------------------------------------------------

    def run_until(self, end_ns: int) -> None:
        """Process all events before ``end_ns``, in order; return early when the monitor has seen a reason to stop.

        What becomes due at the same time behind its place in the order has its turn in another pass.
        """
        faults, wires = self.faults, self.wires
        states, commands, cameras = self.state_link.line, self.command_link.line, self.motion_capture_link.line
        own = self._next_own()
        while self.stop_reason is None:
            now = min(own, states.next_ns, commands.next_ns, cameras.next_ns, faults.next_ns)
            for wire in wires:
                if wire.next_ns < now:
                    now = wire.next_ns
            if now >= end_ns:
                self.now_ns = end_ns
                return
            self.now_ns = now
            if faults.next_ns == now:
                faults.advance(now)
            for b, wire in enumerate(wires):
                if wire.next_ns == now:
                    self._advance(b, wire, now)
            if states.next_ns == now:
                self._receive(states.pop_due(now))
            if commands.next_ns == now:
                self._forward(now, commands.pop_due(now))
            if cameras.next_ns == now:
                self._receive(cameras.pop_due(now))
            if own == now:
                self._tick(now)
                own = self._next_own()

    def _next_own(self) -> int:
        """When ``_tick`` has something to do, which nothing else changes."""
        return min(self._isr_ns, self._control_ns, self._reply_ns, self._exposure_ns)

    def _tick(self, now: int) -> None:
        if self._exposure_ns == now:
            self._expose(now)
        if self._isr_ns == now:
            self.clock.wait_until(now)
            self._tick_joints(now)
        if self._reply_ns == now:
            self._finish_control(now)
        if self._control_ns == now:
            self._start_control(now)

    def _receive(self, arrived: list[tuple[int, Item]]) -> None:
        """What the controller shall find at its next tick."""
        for arrival, (source, can_id, data) in arrived:
            self._arrived.append((arrival, source, can_id, data))

    def _forward(self, now: int, arrived: list[tuple[int, Item]]) -> None:
        """What has come over the link goes to the buses."""
        for _, item in arrived:
            try:
                bus, frame = self.gateway.from_link(item)
            except messages.MalformedMessageError:  # the gateway has counted it
                continue
            if self.faults.commands:
                frame = self.faults.commands.apply(bus, frame)
            self.wires[bus].offer(now, GATEWAY_PORT, frame)

    def _advance(self, b: int, wire: Wire, now: int) -> None:
        for _, sender, frame, missed in wire.advance(now):
            self._deliver(b, now, sender, frame, missed)
        if wire.told:
            for at, port, error in wire.error_frames():
                self._note_error(b, at, port, error)

    def _deliver(self, b: int, now: int, sender: int, frame: Frame, missed: int) -> None:
        """``missed``: bit mask of the ports that a fault keeps the frame from."""
        self.recorder.frame(now, b, frame)
        if self.tap is not None and not missed >> self._tool_port[b] & 1:
            self.tap.broadcast(b, now, sender, frame)
        can_id, data, _, _, extended, remote, _ = frame
        receivers = self._accepts[b].get(can_id)
        if receivers is not None and not extended and not remote:
            for port, joint in receivers:
                if sender != port and not missed >> port & 1:
                    self._inboxes[joint].append(frame)
            # the gateway sends commands alone; what a corrupted frame says is no fact about the run
            if sender == GATEWAY_PORT and type(data) is bytes:
                self.observer.note_command(b, now, self._isr, data, missed)
        if sender != GATEWAY_PORT and not missed >> GATEWAY_PORT & 1:
            item = self.gateway.from_can(now, b, frame)
            if item is not None:
                if self.state_link.at_once():
                    self._arrived.append((now, *item))
                else:
                    self.state_link.send(now, item, 8 * len(data))
                if can_id & 0x780 == messages.STATE and type(data) is bytes:
                    self.observer.note_state(b, sender, data)

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

    def _expose(self, now: int) -> None:
        """Let the cameras look. Since the joints' last tick the physics is ahead, at the time of their next one."""
        system = self.world.motion_capture
        assert system is not None and self._motion_capture_rows is not None
        payload = system.expose(now, (self._isr_ns - now) * 1e-9)
        self.motion_capture_link.send(now, (MOTION_CAPTURE_SOURCE, 0, payload), 8 * len(payload))
        self._motion_capture_rows.append(now, system.row)
        self._exposures += 1
        self._exposure_ns = tick_ns(self._exposures, self._exposure_rate)

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
        self.observer.note_drives(now)

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
        if now >= self.observer.next_ns:
            self.observer.watch(now, self.wires, telemetry)
            if self.monitor is not None:
                self.stop_reason = self.monitor.check(now, self.world.truth(), telemetry, self.observer.drive_row())
        if now >= self._flush_ns:
            self._flush_ns += _FLUSH_NS
            self.recorder.flush(now)
            if self.journal.is_open:
                self.journal.write({"time_ns": now, "digest": self.recorder.digest()})

    # --- observing ----------------------------------------------------------------------------------------------

    def deliveries(self) -> dict[str, dict[str, int]]:
        """What has happened so far to what buses and links carried, by their paths."""
        used = {path: link for path, link in self._links.items() if path != "link.motion_capture" or self._exposures}
        return {path: link.counts for path, link in used.items()} | {
            f"bus.{wire.name}": wire.counts for wire in self.wires
        }

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
        "now_ns", "_isr", "_control", "_isr_ns", "_control_ns", "_reply_ns", "_flush_ns", "tool_frames",
        "stop_reason", "_exposures", "_exposure_ns",
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
            "observer": self.observer.snapshot(),
            "world": self.world.snapshot(),
            "joints": self.joints.snapshot(),
            "controller": self.controller.snapshot(),
            "wires": [wire.snapshot() for wire in self.wires],
            "links": {path: link.snapshot() for path, link in self._links.items()},
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
        self.observer.restore(state["observer"])
        self.world.restore(state["world"])
        self.joints.restore(state["joints"])
        self.controller.restore(state["controller"])
        for wire, saved in zip(self.wires, state["wires"], strict=True):
            wire.restore(saved)
        for path, link in self._links.items():
            link.restore(state["links"][path])
        self.gateway.restore(state["gateway"])
        self.faults.restore(state["faults"])
        self.injector.restore(state["injector"])
        if self.ring is not None:
            self.ring.clear()
        if self.monitor is not None:
            self.monitor.restore(state["monitor"])


