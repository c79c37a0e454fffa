"""Faults of a bus's nodes as a whole system sees them."""

from __future__ import annotations

from typing import Any

from bus import messages
from bus.confinement import State
from bus.frames import Frame
from bus.wire import QUEUE
from hil.run import Request, assemble
from hil.scenario import load
from hil.system import Tap

MILLISECOND = 1_000_000


class Tools(Tap):
    """Stands for attached tools: hears everything, says nothing."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, int, int, Frame]] = []

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        self.heard.append((bus, time_ns, sender, frame))

    def poll(self) -> list[tuple[int, Frame]]:
        return []


class Inboxes:
    """Between the system and its joints: who is given commands."""

    def __init__(self, joints: Any) -> None:
        self._joints = joints
        self.commands: list[tuple[int, int]] = []  # time, joint

    def start(self, now_ns: int, inboxes: list[list[Frame]], *rest: Any) -> Any:
        for joint, inbox in enumerate(inboxes):
            self.commands += [(now_ns, joint) for frame in inbox if frame.id == messages.COMMAND]
        return self._joints.start(now_ns, inboxes, *rest)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._joints, name)


def test_a_cut_joint_neither_hears_commands_nor_is_heard() -> None:
    with assemble(Request(load("split-terrain", []), seed=1, backend="inline")) as assembly:
        system = assembly.system
        system.tap = tools = Tools()
        system.joints = inboxes = Inboxes(system.joints)
        system.run_until(100 * MILLISECOND)
        system.wires[0].cut(2, True, system.now_ns)
        system.run_until(130 * MILLISECOND)
    joint = system._joints_of[0][1]
    cut = 100 * MILLISECOND + 200_000  # what was under way is through
    assert {sender for b, at, sender, _ in tools.heard if b == 0 and at < cut} == {0, 1, 2, 3}
    assert {sender for b, at, sender, _ in tools.heard if b == 0 and at > cut} == {0, 1, 3}
    assert {j for at, j in inboxes.commands if at < cut} == set(range(6))
    assert {j for at, j in inboxes.commands if at > cut + MILLISECOND} == set(range(6)) - {joint}
    assert system.wires[0].waiting(2) == QUEUE and system.wires[0].refused > 0


def test_a_stuck_bus_falls_silent_and_comes_back() -> None:
    with assemble(Request(load("split-terrain", []), seed=1, backend="inline")) as assembly:
        system = assembly.system
        system.tap = tools = Tools()
        wire = system.wires[0]
        system.run_until(100 * MILLISECOND + 100_000)  # amid the joints' reports
        wire.stuck_dominant(1, True, system.now_ns)
        system.run_until(110 * MILLISECOND)
        assert {wire.ports_state(port).state for port in range(wire.ports)} <= {State.ERROR_PASSIVE, State.BUS_OFF}
        assert not [at for b, at, _, _ in tools.heard if b == 0 and at > 100 * MILLISECOND + 100_000]
        wire.stuck_dominant(1, False, system.now_ns)
        system.run_until(140 * MILLISECOND)
        assert {sender for b, at, sender, _ in tools.heard if b == 0 and at > 110 * MILLISECOND} == {0, 1, 2, 3}
        assert all(wire.ports_state(port).state is not State.BUS_OFF for port in range(wire.ports))
        assert [at for b, at, _, _ in tools.heard if b == 1 and 100 < at / MILLISECOND < 110]  # the other leg goes on
