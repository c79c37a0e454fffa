"""Faults of nodes that are the wire's, by their keys, in the closed loop."""

from collections import Counter
from typing import Any

import numpy as np

from bus import messages
from bus.frames import Frame
from hil.run import Outcome, Request, run
from hil.scenario import load
from hil.system import Tap
from robots import description

MS = 1_000_000
KNEE = "bus.left_leg.node.left_knee"
ROBOT = description.load("hume")
LEFT = next(b for b, bus in enumerate(ROBOT.buses) if bus.name == "left_leg")
STATES = {name: messages.STATE + ROBOT.joint(name).node_id for name in ROBOT.buses[LEFT].joints}
OTHERS = [name for name in STATES if name != "left_knee"]


class Listener(Tap):
    """In the place of attached tools: notes (time, identifier) of the left leg's bus."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, int]] = []

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        if bus == LEFT:
            self.heard.append((time_ns, frame.id))

    def broadcast_error(self, *_: Any) -> None:
        pass

    set_state = refused = broadcast_error

    def poll(self) -> list[tuple[int, Frame]]:
        return []

    def count(self, start: float, end: float) -> Counter[int]:
        """By identifier, between two times in ms."""
        return Counter(i for t, i in self.heard if start * MS <= t < end * MS)


def hung(*inject: str, backend: str = "inline") -> tuple[Outcome, Listener, Any]:
    """A run of 0.3 s, drives on, the robot in its hoist, with injections "at ms, key, value[, until]"."""
    entries = []
    for text in inject:
        at, key, value, *until = text.split(", ")
        end = f", until='{until[0]}ms'" if until else ""
        entries.append(f"{{at='{at}ms', key='{key}', value='{value}'{end}}}")
    settings = ["duration=0.3s", "controller.stand_at=0.05s", "world.hoist.hold=1s", f"inject=[{', '.join(entries)}]"]
    listener, systems = Listener(), []

    def prepare(assembly: Any) -> None:
        assembly.system.tap = listener
        systems.append(assembly.system)

    outcome = run(Request(load("stand", settings), 3, backend, report=False), prepare=prepare)
    return outcome, listener, systems[0]


def test_a_cut_cable_silences_one_node_and_its_watchdog_bites() -> None:
    outcome, listener, system = hung(f"200, {KNEE}.cut, true, 210")
    before, during = listener.count(190, 200), listener.count(201, 210)
    assert before[STATES["left_knee"]] == 15 and during[STATES["left_knee"]] == 0
    assert all(during[STATES[name]] >= 13 for name in OTHERS) and during[messages.COMMAND] >= 13
    assert system.wires[LEFT].errors == 0  # it was not sending when the cable was cut, and the others acknowledge
    # back on the bus it tells that it has heard nothing for longer than its watchdog
    assert outcome.record["reason"].startswith(("drive in quick stop: left_knee", "drive in fault: left_knee"))
    assert 0.21 <= outcome.record["simulated_time"] < 0.23


def test_the_gateways_cable_takes_all_drives_of_the_bus_along() -> None:
    outcome, listener, _ = hung("200, bus.left_leg.node.gateway.cut, true")
    late = listener.count(202, 300)
    assert late[messages.COMMAND] == 0 and all(late[state] > 0 for state in STATES.values())
    assert float(outcome.tables["controller"]["missed_states"][-1]) > 3 * 100
    assert any(late[messages.EMERGENCY + ROBOT.joint(name).node_id] for name in STATES)


def test_a_wire_held_dominant_carries_nothing() -> None:
    outcome, listener, system = hung(f"200, {KNEE}.stuck_dominant, true")
    assert listener.count(190, 200).total() >= 60 and listener.count(201, 300).total() == 0
    sent = {bus: outcome.tables["bus"][f"sent.{bus}"][-1] for bus in ("right_leg", "left_leg")}
    assert sent["right_leg"] - sent["left_leg"] > 500  # the other bus goes on
    assert system.wires[LEFT].errors > 0


def test_a_node_at_a_wrong_bit_rate_destroys_frames_until_it_is_off_the_bus() -> None:
    _, listener, system = hung(f"200, {KNEE}.bit_rate, 1.1")
    late = listener.count(250, 300)
    assert late[STATES["left_knee"]] == 0
    assert system.wires[LEFT].errors > 10
    port = ROBOT.buses[LEFT].joints.index("left_knee") + 1
    assert system.wires[LEFT].ports_state(port).tec > 127 or system.wires[LEFT].ports_state(port).rec > 127


def test_one_damaged_bit_costs_one_retransmission_and_no_frame() -> None:
    plain, _, clean = hung()
    outcome, listener, system = hung(f"200, bus.left_leg.damage, {STATES['left_knee']:#x} crc:3")
    assert (clean.wires[LEFT].errors, system.wires[LEFT].errors) == (0, 1)
    counts = listener.count(150, 250)
    assert counts[STATES["left_knee"]] == counts[STATES["left_hip"]] == 150
    same = outcome.tables["world"].times < 200 * MS
    assert np.array_equal(outcome.tables["world"].data[same], plain.tables["world"].data[same])


def test_all_of_them_give_one_digest_on_both_backends() -> None:
    inject = [
        f"120, {KNEE}.cut, true, 122", f"130, {KNEE}.bit_rate, 1.05, 131", f"140, {KNEE}.stuck_dominant, true, 141",
        f"150, bus.left_leg.damage, {STATES['left_hip']:#x} data:12 3", f"160, {KNEE}.one_shot, true, 200",
        f"170, {KNEE}.listen_only, true, 172", f"200, {KNEE}.restart, true",
        "210, bus.left_leg.node.left_hip.node_id, 6, 213",
    ]  # fmt: skip
    inline, _, system = hung(*inject)
    assert system.wires[LEFT].errors > 0
    assert hung(*inject, backend="processes")[0].record["log_digest"] == inline.record["log_digest"]
