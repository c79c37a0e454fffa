"""The faults of nodes, and the nodes that only disturb: where each takes effect in a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from bus import messages
from bus.frames import BASE_ID_LIMIT, Frame
from bus.impairment import NEVER
from bus.link import Link
from bus.talkers import Babbler, BackgroundTraffic, Talker
from bus.wire import Wire
from hil.errors import UserError
from hil.injection import GATEWAY, Set
from hil.scenario import Scenario
from hil.senders import Senders
from hil.streams import StreamFactory
from robots.description import Robot

# Faults of a node that are the wire's: its method, which takes port, value and time.
_ON_THE_WIRE = {
    "cut": "cut", "stuck_dominant": "stuck_dominant", "listen_only": "listen_only", "one_shot": "one_shot",
    "bit_rate": "bit_rate_error",
}  # fmt: skip


_NONSENSE = {"not_a_number": -(2**31), "out_of_range": round(1e5 / messages.NEWTON_METRE)}  # counts


class SpoiledCommands:
    """Command frames whose set-points for some joints make no sense, as from a controller gone wrong.

    ``slots``: by joint its bus and its slot.
    """

    def __init__(self, slots: Mapping[int, tuple[int, int]]) -> None:
        self._slots = slots
        self._kinds: dict[int, str] = {}  # by joint

    def __bool__(self) -> bool:
        return bool(self._kinds)

    def set(self, joint: int, kind: str) -> None:
        self._kinds.pop(joint, None)
        if kind != "ok":
            self._kinds[joint] = kind

    def apply(self, bus: int, frame: Frame) -> Frame:
        """What the gateway sends instead of ``frame``."""
        if frame.id != messages.COMMAND or len(frame.data) != messages.COMMAND_LENGTH:
            return frame
        data = bytearray(frame.data)
        for joint, kind in self._kinds.items():
            where, slot = self._slots[joint]
            if where == bus:
                messages.overwrite_torque(data, slot, _NONSENSE[kind])
        return frame._replace(data=bytes(data))

    def snapshot(self) -> dict[int, str]:
        return dict(self._kinds)

    def restore(self, state: dict[int, str]) -> None:
        self._kinds = dict(state)


class JointSetter:
    """Takes the injected values of one joint: the plant's, and those of its commands."""

    def __init__(self, joint: int, plant: Any, commands: SpoiledCommands) -> None:
        self._joint, self._plant, self._commands = joint, plant, commands

    def __call__(self, key: str, value: Any, now_ns: int) -> None:
        """Set ``key`` to ``value``. Raises KeyError for a key that a joint has not."""
        if key == "command":
            self._commands.set(self._joint, value)
        else:
            self._plant.set(self._joint, key, value)


class NodeSetter:
    """Takes the injected values of the node at ``port`` of ``wire``; ``joint``: its number, None for the gateway.

    ticks: how often the joints have ticked so far.
    """

    def __init__(
        self, wire: Any, port: int, joint: int | None, senders: Senders | None, ticks: Callable[[], int] = lambda: 0
    ) -> None:
        self._wire, self._port = wire, port
        self._joint, self._senders, self._ticks = joint, senders, ticks

    def __call__(self, key: str, value: Any, now_ns: int) -> None:
        """Set ``key`` to ``value``. Raises KeyError for a key that this node has not."""
        if key in _ON_THE_WIRE:
            getattr(self._wire, _ON_THE_WIRE[key])(self._port, value, now_ns)
        elif key == "restart":
            if value:
                self._wire.restart(self._port, now_ns)
        elif self._joint is None or self._senders is None:
            raise KeyError(key)
        elif key == "node_id":
            self._senders.set_node_id(self._joint, value)
        elif key == "drift":
            self._senders.set_drift(self._joint, value, self._ticks())
        else:
            raise KeyError(key)


class Faults:
    """What is wrong with the nodes of a run: senders off their time or identifier, and talkers on every bus.

    Event driven: ``next_ns`` tells when ``advance`` has something to do. On every wire the last port is that of
    attached tools; the two before it are the babbling idiot's and the background traffic's.

    Args:
        places: (bus, port) by joint.
        plant: takes the faults of joints, ``set(joint, key, value)``.
        ticks: how often the joints have ticked so far.
        motion_capture: takes what hides its LEDs, ``set(key, value)``; None: there is none.
    """

    PORTS = 2  # on every wire

    def __init__(
        self,
        scenario: Scenario,
        robot: Robot,
        wires: Sequence[Wire],
        places: Mapping[int, tuple[int, int]],
        plant: Any,
        streams: StreamFactory,
        ticks: Callable[[], int],
        motion_capture: Any = None,
    ) -> None:
        self._plant, self._motion_capture = plant, motion_capture
        self.commands = SpoiledCommands({joint: (bus, port - 1) for joint, (bus, port) in places.items()})
        self._robot, self._wires, self._places, self._ticks = robot, wires, places, ticks
        self.senders = Senders(wires, places, int(scenario.firmware.rate))
        self._talkers: dict[str, Talker] = {}
        for wire in wires:
            config = scenario.bus[wire.name]
            self._talkers[f"bus.{wire.name}.babble"] = Babbler(wire, wire.ports - 3, config.babble)
            self._talkers[f"bus.{wire.name}.background"] = BackgroundTraffic(wire, wire.ports - 2, config, streams)
        self.next_ns = NEVER
        self.look()

    def look(self) -> None:
        """Find out when the next event is: after anything but ``advance`` that may have changed it."""
        self.next_ns = min(self.senders.next_ns, *[talker.next_ns for talker in self._talkers.values()])

    def advance(self, now_ns: int) -> None:
        """Offer to the wires what is due."""
        for talker in self._talkers.values():
            talker.advance(now_ns)
        self.senders.advance(now_ns)
        self.look()

    def setters(self, links: Mapping[str, Link]) -> dict[str, Set]:
        """Who takes the injectable keys under which path; ``links`` by path."""
        setters: dict[str, Set] = {path: partial(_set_link, link) for path, link in links.items()}
        setters |= {f"bus.{wire.name}": partial(set_wire, wire) for wire in self._wires}
        setters |= {path: partial(self._set_talker, talker) for path, talker in self._talkers.items()}
        for bus, wire in zip(self._robot.buses, self._wires, strict=True):
            for port, name in enumerate((GATEWAY, *bus.joints)):
                joint = self._robot.joint_names.index(name) if port else None
                setters[f"bus.{bus.name}.node.{name}"] = NodeSetter(wire, port, joint, self.senders, self._ticks)
        for joint, name in enumerate(self._robot.joint_names):
            setters[f"joint.{name}"] = JointSetter(joint, self._plant, self.commands)
        setters["motion_capture"] = self._set_motion_capture
        return setters

    def _set_motion_capture(self, key: str, value: Any, now_ns: int) -> None:
        if self._motion_capture is not None:  # else there is nothing that could be hidden
            self._motion_capture.set(key, value)

    def _set_talker(self, talker: Talker, key: str, value: Any, now_ns: int) -> None:
        talker.set(key, value, now_ns)
        self.look()

    def snapshot(self) -> dict[str, Any]:
        talkers = {path: talker.snapshot() for path, talker in self._talkers.items()}
        return {"senders": self.senders.snapshot(), "talkers": talkers, "commands": self.commands.snapshot()}

    def restore(self, state: dict[str, Any]) -> None:
        self.senders.restore(state["senders"])
        self.commands.restore(state["commands"])
        for path, talker in self._talkers.items():
            talker.restore(state["talkers"][path])
        self.look()


def _set_link(link: Link, key: str, value: Any, now_ns: int) -> None:
    link.set(key, value)


def set_wire(wire: Wire, key: str, value: Any, now_ns: int) -> None:
    """Set a key that is the wire's own. Raises KeyError for another, UserError for a wrong value."""
    if key != "damage":
        wire.set(key, value)
    elif value:
        identifier, bit, *attempt = value.split()
        number = int(identifier, 0)
        place = int(bit) if bit.isdecimal() else bit
        try:
            extended = number >= BASE_ID_LIMIT
            wire.damage(number, int(attempt[0]) if attempt else 1, place, extended=extended)
        except ValueError as error:
            raise UserError(f"damage = {value!r}: {error}") from None
