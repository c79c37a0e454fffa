"""The processes backend on SocketCAN: the frames of the joints cross the kernel.

Two ways:

- ``socketcan``: one interface per joint (``left_leg.6``: bus and node id), and the emulated wire between them. Frame
  times, arbitration and faults are the wire's; a run has the digest that it has in shared memory. Each bus has one more
  interface (``left_leg``), a port of its own on the wire, which shows the whole bus and takes the frames of tools.
- ``socketcan-plain``: one interface per bus, and nothing between its nodes but the kernel: no frame times, no faults.
  A frame sent at one tick of the joints reaches the other joints at the next, the gateway at once.

The kernel delivers when it likes, so nothing here depends on when: before a tick the launcher tells each joint how
many frames are on the way to it, and the joint takes just these; after it the joint has told how many it has sent. On
each interface the launcher sees what the joints see; what is more than they sent is a tool's (``foreign``).
"""

from __future__ import annotations

import mmap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bus import messages
from bus.frames import Frame
from bus.link import NEVER
from bus.socketcan import Interfaces, SocketCanError, SocketCanPort
from bus.wire import Delivery
from hil.backends.lifecycle import STUCK_AFTER_S, Family
from hil.backends.processes import _IDLE, _TICK, _TIME, _WHAT, ProcessJoints, SharedPins
from hil.backends.socketcan_tools import Taps, ToolInterfaces, reported
from hil.errors import EmulationError, UserError
from hil.faults import Faults
from robots.description import Robot

if TYPE_CHECKING:
    from hil.scenario import Scenario
    from joint_firmware.firmware import JointFirmware

MODES = ("socketcan", "socketcan-plain")
GATEWAY_PORT = 0
_EXPECTED, _SENT = 0, 1  # words of a joint's counts: frames on the way to it, frames it has sent since the start
_FROM_NODES = (messages.EMERGENCY, messages.STATE, 0x580, messages.HEARTBEAT)  # + node id; 0x580: SDO answers


class _NodePort:
    """A joint's end of its interface."""

    def __init__(self, interface: str, counts: memoryview) -> None:
        self._port = SocketCanPort(interface)
        self._counts = counts
        self.shutdown = self._port.shutdown

    def recv_frames(self) -> list[Frame]:
        return self._port.take(self._counts[_EXPECTED], STUCK_AFTER_S)

    def send_frame(self, frame: Frame) -> None:
        self._port.send_frame(frame)
        self._counts[_SENT] += 1


class _ListeningPort(_NodePort):
    """Beside a real drive on its interface: takes what has come, as nobody knows when it sends."""

    def recv_frames(self) -> list[Frame]:
        return self._port.waiting()[1]


class _SocketCanJoints(ProcessJoints):
    """What both ways share: joints whose ports are interfaces, and how many frames passed them."""

    def __init__(
        self, family: Family, nodes: Sequence[JointFirmware], names: Sequence[str], interfaces: Sequence[str],
        shared: SharedPins, external: frozenset[int] = frozenset(),
    ) -> None:  # fmt: skip
        self._external = external
        memory = memoryview(mmap.mmap(-1, 16 * len(nodes))).cast("q")
        self._counts = [memory[2 * j : 2 * j + 2] for j in range(len(nodes))]
        self._seen = [0] * len(nodes)
        super().__init__(family, nodes, names, interfaces, shared)

    def _firmware_port(self, joint: int, channel: str, shared: SharedPins) -> Any:
        return (_ListeningPort if joint in self._external else _NodePort)(channel, self._counts[joint])

    def _sent(self, joint: int) -> int:
        """How many frames the joint has sent since the last call."""
        total = self._counts[joint][_SENT]
        sent, self._seen[joint] = total - self._seen[joint], total
        return sent


class TimedJoints(_SocketCanJoints):
    """One interface per joint."""

    foreign = 0  # frames that were neither the joint's nor the wire's: sent as if by the joint

    def connect(self, interfaces: Sequence[str]) -> None:
        """Open the wire's ends, once all joints are there."""
        self._ends = [SocketCanPort(name) for name in interfaces]
        self._extra = [0] * len(self._ends)

    def start(self, now_ns: int, inboxes: list[list[Frame]], idle: Sequence[int] = ()) -> None:
        self._idle = idle
        with reported():
            for j, (order, end, inbox) in enumerate(zip(self._orders, self._ends, inboxes, strict=True)):
                for frame in inbox:
                    end.send_frame(frame)
                order[_TIME] = now_ns
                if j in idle:
                    order[_WHAT] = _IDLE
                else:
                    order[_WHAT] = _TICK
                    self._counts[j][_EXPECTED] = len(inbox) + self._extra[j]
        self._order()

    def finish(self) -> list[list[Frame]]:
        self._family.wait(self._done, "the joints")
        outboxes: list[list[Frame]] = []
        with reported():
            for j, end in enumerate(self._ends):
                if j in self._idle:
                    outboxes.append([])
                    continue
                frames = end.take(self._sent(j), STUCK_AFTER_S)
                self._extra[j], more = end.waiting()
                self.foreign += self._extra[j]
                outboxes.append(frames + more)
        return outboxes

    def close(self) -> None:
        for end in self._ends:
            end.shutdown()


class KernelWire:
    """The calendar's side of a bus that is an interface of the kernel: nothing on it takes time."""

    busy_ns = lost = errors = refused = 0
    told: tuple[()] = ()

    def __init__(self, name: str, end: SocketCanPort, node_ids: Sequence[int]) -> None:
        self.name = name
        self.ports = len(node_ids) + 2 + Faults.PORTS
        self._end = end
        self._port_of = {base + node: n for base in _FROM_NODES for n, node in enumerate(node_ids, GATEWAY_PORT + 1)}
        self._queue: list[Delivery] = []
        self.sent = 0
        self.given = 0  # frames that the launcher has put on the bus since the last tick

    def offer(self, now_ns: int, port: int, frame: Frame) -> bool:
        """Put a frame of the gateway's or a tool's on the bus."""
        with reported():
            self._end.send_frame(frame)
        self.given += 1
        self._queue.append(Delivery(now_ns, port, frame))
        return True

    def arrived(self, now_ns: int, frame: Frame) -> None:
        """A frame that the kernel has brought: a joint's by its identifier, or a tool's."""
        self._queue.append(Delivery(now_ns, self._port_of.get(frame.id, self.ports - 1), frame))

    @property
    def next_ns(self) -> int:
        return self._queue[0].time if self._queue else NEVER

    def advance(self, now_ns: int) -> list[Delivery]:
        queue, self._queue = self._queue, []
        self.sent += len(queue)
        return queue

    def error_frames(self) -> list[Any]:
        return []

    def ports_state(self, port: int) -> tuple[int, int, int]:
        """No errors are counted: error active."""
        return 0, 0, 0

    @property
    def counts(self) -> dict[str, int]:
        return {"sent": self.sent}

    def traffic(self) -> dict[Any, Any]:
        return {}

    def _refuse(self, *_: Any, **__: Any) -> None:
        raise UserError(f"bus.{self.name}: a plain SocketCAN bus has no faults, use --can socketcan")

    cut = stuck_dominant = listen_only = one_shot = bit_rate_error = restart = damage = _refuse

    def set(self, key: str, value: float) -> None:
        raise UserError(f"bus.{self.name}.{key}: a plain SocketCAN bus has no impairments, use --can socketcan")

    def snapshot(self) -> Any:
        raise EmulationError("a run on a plain SocketCAN bus has no snapshot: frames wait in the kernel")

    restore = snapshot


class PlainJoints(_SocketCanJoints):
    """One interface per bus."""

    foreign = 0  # frames of tools

    def connect(self, robot: Robot, interfaces: Sequence[str]) -> list[KernelWire]:
        """Open the launcher's ends, once all joints are there. Returns the buses."""
        order = {name: j for j, name in enumerate(robot.joint_names)}
        ids = {joint.name: joint.node_id for joint in robot.joints}
        self._ends = [SocketCanPort(name) for name in interfaces]
        self._joints_of = [[order[name] for name in bus.joints] for bus in robot.buses]
        self._waiting = [0] * len(ids)  # frames of the last tick on the way to each joint
        self._now = 0
        self.wires = [
            KernelWire(bus.name, end, [ids[name] for name in bus.joints])
            for bus, end in zip(robot.buses, self._ends, strict=True)
        ]
        return self.wires

    def start(self, now_ns: int, inboxes: list[list[Frame]], idle: Sequence[int] = ()) -> None:
        """``inboxes`` have come through the kernel already."""
        if idle:
            raise UserError("a node's drift needs the emulated wire: use --can shm or --can socketcan")
        for wire, joints in zip(self.wires, self._joints_of, strict=True):
            given, wire.given = wire.given, 0
            for j in joints:
                self._counts[j][_EXPECTED] = self._waiting[j] + given
                self._orders[j][_TIME] = now_ns
        self._now = now_ns
        self._order()

    def finish(self) -> list[list[Frame]]:
        self._family.wait(self._done, "the joints")
        with reported():
            for wire, end, joints in zip(self.wires, self._ends, self._joints_of, strict=True):
                sent = {j: self._sent(j) for j in joints}
                total = sum(sent.values())
                frames = end.take(total, STUCK_AFTER_S)
                foreign, more = end.waiting()
                self.foreign += foreign
                for j in joints:
                    self._waiting[j] = total - sent[j] + foreign
                for frame in frames + more:
                    wire.arrived(self._now, frame)
        return [[] for _ in self._orders]

    def close(self) -> None:
        for end in self._ends:
            end.shutdown()


def external_joints(robot: Robot, node_ids: Sequence[int]) -> frozenset[int]:
    """Indices of the joints with these node ids. Raises UserError for an id that no joint has."""
    index = {joint.node_id: j for j, joint in enumerate(robot.joints)}
    for node in node_ids:
        if node not in index:
            listed = ", ".join(f"{joint.node_id} ({joint.name})" for joint in robot.joints)
            raise UserError(f"--external {node}: no joint has this node id; there are {listed}")
    return frozenset(index[node] for node in node_ids)


def interface_names(robot: Robot, mode: str) -> tuple[list[str], list[str]]:
    """Interfaces of the buses, and those of the joints in the order of the robot's."""
    buses = [bus.name for bus in robot.buses]
    bus_of = {name: bus.name for bus in robot.buses for name in bus.joints}
    if mode == "socketcan-plain":
        return buses, [bus_of[joint.name] for joint in robot.joints]
    return buses, [f"{bus_of[joint.name]}.{joint.node_id}" for joint in robot.joints]


class SocketCan:
    """SocketCAN for one run: its interfaces, for as long as the context lasts, and what takes the place of the default.

    Args:
        robot: its buses and node ids name the interfaces.
        scenario: must not want faults of a plain bus.
        mode: one of MODES.
        external: node ids of joints that are real hardware.
        renamed: other interfaces to use (``can0``) by the name that they would have (``left_leg.6``).

    Raises UserError where SocketCAN cannot be had, and for what the arguments must not be.
    """

    def __init__(
        self, robot: Robot, scenario: Scenario, mode: str, external: Sequence[int] = (),
        renamed: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        self._robot, self._mode = robot, mode
        self._external = external_joints(robot, external)
        if mode == "socketcan-plain":
            _refuse_faults(scenario)
        buses, joints = interface_names(robot, mode)
        renamed = renamed or {}
        for name in renamed:
            if name not in buses and name not in joints:
                listed = ", ".join(dict.fromkeys([*buses, *joints]))
                raise UserError(f"--interface {name}={renamed[name]}: there is no {name}, only {listed}")
        self._buses = [renamed.get(name, name) for name in buses]
        self._of_joints = [renamed.get(name, name) for name in joints]
        distinct = {*buses, *joints}
        if len({*self._buses, *self._of_joints}) < len(distinct):
            raise UserError("--interface: one interface cannot take the place of two")
        self._joints: TimedJoints | PlainJoints | None = None

    def __enter__(self) -> SocketCan:
        try:
            self._interfaces = Interfaces(list(dict.fromkeys([*self._buses, *self._of_joints])))
        except SocketCanError as error:
            raise UserError(str(error)) from None
        return self

    def __exit__(self, *_: object) -> None:
        if self._joints is not None:
            self._joints.close()
        self._interfaces.close()

    def joints(self, family: Family, nodes: Sequence[JointFirmware], shared: SharedPins) -> TimedJoints | PlainJoints:
        """The joints' processes."""
        kind = PlainJoints if self._mode == "socketcan-plain" else TimedJoints
        try:
            self._joints = kind(family, nodes, self._robot.joint_names, self._of_joints, shared, self._external)
        except SocketCanError as error:
            raise UserError(str(error)) from None
        return self._joints

    def connect(self, system: Any) -> None:
        """Put the kernel where it belongs in a system that was built for the default."""
        if isinstance(self._joints, PlainJoints):
            system.wires = self._joints.connect(self._robot, self._buses)
        elif self._joints is not None:
            self._joints.connect(self._of_joints)

    def tools(self, tap: Any) -> Any:
        """``tap`` with the interfaces of whole buses; on plain buses every tool is a node already."""
        if self._mode == "socketcan-plain":
            return tap
        interfaces = ToolInterfaces(self._buses)
        return interfaces if tap is None else Taps([tap, interfaces])


def _refuse_faults(scenario: Scenario) -> None:
    for name, config in scenario.bus.items():
        clean = type(config)()
        for key in type(config).model_fields:
            if key not in ("arbitration_rate", "data_rate") and getattr(config, key) != getattr(clean, key):
                raise UserError(f"bus.{name}.{key}: a plain SocketCAN bus has no impairments, use --can socketcan")
    for injection in scenario.inject:
        if injection.key.startswith("bus."):
            raise UserError(f"{injection.key}: a plain SocketCAN bus has no impairments, use --can socketcan")
