"""Every fault as the closed loop shows it."""

import json
import re
from collections import Counter
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from bus import messages
from bus.frames import Frame
from hil.errors import UserError
from hil.faults import NodeSetter, set_wire
from hil.injection import Injector, injectable
from hil.record.journal import Journal
from hil.run import Outcome, Request, assemble, run
from hil.scenario import load, parse_value
from hil.system import Tap
from robots import description

# the robot hangs: no fault ends the run
HUNG = ["duration=0.4s", "controller.stand_at=0.05s", "world.hoist.hold=1s", "limits.drive_silent=1s"]


class Listener(Tap):
    """In the place of attached tools: notes (bus, time, sender, frame)."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, int, int, Frame]] = []

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        self.heard.append((bus, time_ns, sender, frame))

    def poll(self) -> list[tuple[int, Frame]]:
        return []


def hung(*settings: str, backend: str = "inline", seed: int = 3) -> tuple[Outcome, Listener, Any]:
    listener, systems = Listener(), []

    def prepare(assembly: Any) -> None:
        assembly.system.tap = listener
        systems.append(assembly.system)

    request = Request(load("stand", [*HUNG, *settings]), seed, backend, report=False)
    outcome = run(request, prepare=prepare)
    return outcome, listener, systems[0]


@pytest.fixture(scope="module")
def clean() -> Outcome:
    return hung()[0]


def missed(outcome: Outcome) -> float:
    return float(outcome.tables["controller"]["missed_states"][-1])


def round_trips(outcome: Outcome, side: str) -> np.ndarray:
    drives = outcome.tables["drives"]
    values = np.concatenate([drives[name] for name in drives.names if name.startswith(f"round_trip.{side}")])
    return values[np.isfinite(values)]


def test_a_tenth_lost_on_a_bus_is_a_tenth_of_its_states_missing(clean: Outcome) -> None:
    outcome, _, system = hung("bus.left_leg.loss=0.1")
    ticks = np.count_nonzero(outcome.tables["controller"]["phase"] > 0)
    share = (missed(outcome) - missed(clean)) / (3 * ticks)
    assert share == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / (3 * ticks)))
    right, left = (wire.counts for wire in system.wires)
    assert left["lost"] / left["sent"] == pytest.approx(0.1, abs=0.02) and right["lost"] == 0


def test_delay_shows_in_the_round_trip(clean: Outcome) -> None:
    """That of a bus once, by its command: its states still reach the controller before the same tick."""
    before = np.median(round_trips(clean, "left"))
    outcome, _, _ = hung("bus.left_leg.delay=100us")
    assert np.median(round_trips(outcome, "left")) - before == pytest.approx(100e-6, abs=2e-6)
    # the other bus: but for stuff bits, other torques being commanded
    assert np.median(round_trips(outcome, "right")) == pytest.approx(np.median(round_trips(clean, "right")), abs=1e-6)
    period, _, _ = hung("link.command.delay=666667ns")  # the commands meet the same traffic one period later
    assert np.median(round_trips(period, "left")) - before == pytest.approx(2e-3 / 3, abs=2e-6)


def test_duplicates_are_seen_and_change_nothing(clean: Outcome) -> None:
    outcome, listener, system = hung(*(f"{key}.duplicate=1" for key in ("bus.left_leg", "bus.right_leg", "link.state")))
    assert (outcome.tables["world"].data == clean.tables["world"].data).all()
    assert (outcome.tables["controller"].data == clean.tables["controller"].data).all()
    assert all(wire.counts["duplicated"] == wire.counts["sent"] > 500 for wire in system.wires)
    assert len(listener.heard) == 2 * sum(wire.counts["sent"] for wire in system.wires)
    assert system.state_link.counts["duplicated"] == system.state_link.counts["sent"] > 500


def test_a_duplicated_command_is_on_the_bus_twice_and_obeyed_once(clean: Outcome) -> None:
    outcome, listener, system = hung("link.command.duplicate=1")
    commands = [f.data for bus, _, _, f in listener.heard if bus == 1 and f.id == messages.COMMAND]
    assert commands[:400:2] == commands[1:400:2] and len(set(commands[:400])) == 200
    assert system.command_link.counts["duplicated"] > 500
    assert outcome.record["verdict"] == clean.record["verdict"]


def test_reordered_states_are_ignored_and_missed(clean: Outcome) -> None:
    outcome, _, system = hung("link.state.reorder=0.2")
    assert system.state_link.counts["reordered"] > 100
    assert missed(outcome) > missed(clean)


def test_corruption_reaches_the_controller_unnoticed(clean: Outcome) -> None:
    outcome, _, system = hung("link.state.corruption=0.01")
    assert system.state_link.counts["corrupted"] > 20
    assert outcome.record["deliveries"]["link.state"]["corrupted"] == system.state_link.counts["corrupted"]
    assert outcome.tables["controller"]["malformed"][-1] == 0
    # what it makes of them may be commands that the drives refuse: then the run ends early
    seen = outcome.tables["controller"].data
    assert (seen != clean.tables["controller"].data[: len(seen)]).any()
    assert outcome.record["verdict"] == "stable" or "command (8900h)" in outcome.record["reason"]


def test_a_corrupted_word_is_no_fact_about_the_drive_or_the_round_trip(clean: Outcome) -> None:
    """What the controller makes of it is another thing: it answers to what it read."""
    outcome, _, system = hung("bus.left_leg.corruption=0.05", "link.command.corruption=0.02", "controller.stand_at=9s")
    assert system.wires[1].counts["corrupted"] > 50
    for name in ("statusword.left_knee", "statusword.left_hip"):
        words = [run.tables["drives"][name].astype(int) for run in (outcome, clean)]
        states, known = (set(word & ~messages.Statusword.LIMITED) for word in words)
        assert states <= known  # a drive that was sent a corrupted set-point limits it
    outcome, _, _ = hung("link.command.corruption=0.02", "bus.left_leg.corruption=0.02", seed=5)
    assert round_trips(outcome, "left").max() < 5e-3


def any_value(random: Random, entry: Any) -> str:
    """A valid value of an injectable key, at random."""
    if entry.default == "":
        return f"{random.randrange(0x800):#x} {random.randrange(200)} {random.randint(1, 9)}"
    bounds = re.fullmatch(r"(\S+) to (\S+)(?: (.+))?", entry.range)
    if bounds is None:
        return random.choice(re.split(r", | or ", entry.range))
    low, high, unit = float(bounds[1]), float(bounds[2]), bounds[3] or ""
    if isinstance(entry.default, int):
        return str(random.randint(int(low), int(high)))
    scale = random.choice((1.0, 1e-3, 1e-6)) if low == 0 else 1.0
    return f"{scale * random.uniform(low, high)!r}{unit}"


@pytest.mark.parametrize("seed", range(3))
def test_any_sequence_of_injections_is_survived_and_repeated(seed: int) -> None:
    def digest() -> str:
        random = Random(seed)
        with assemble(Request(load("stand", HUNG), seed, "inline")) as assembly:
            system = assembly.system
            system.monitor = None  # it would end the run
            known = injectable(description.load("hume"))
            for n in range(60):
                key, entry = random.choice(list(known.items()))
                system.requests.append(partial(system.inject, key, any_value(random, entry)))
                system.run_until((n + 1) * 4_000_000)
            assert len(system.injected) == 60
            return assembly.recorder.digest()

    assert digest() == digest()


def test_background_adds_its_share_to_the_load_of_the_bus(clean: Outcome) -> None:
    outcome, listener, _ = hung("bus.left_leg.background.load=0.2", "bus.left_leg.background.identifier=0x300")
    for bus, more in (("left_leg", 0.2), ("right_leg", 0.0)):
        loads = [float(np.mean(o.tables["bus"][f"load.{bus}"][5:])) for o in (outcome, clean)]
        assert loads[0] - loads[1] == pytest.approx(more, abs=0.01)
    assert {f.id for bus, _, _, f in listener.heard if bus == 1} >= set(range(0x300, 0x310))


def test_a_babbling_idiot_silences_the_drives_of_its_bus_only() -> None:
    outcome, listener, _ = hung("inject=[{at='0.2s', key='bus.left_leg.babble.rate', value='100kHz'}]")
    late = [(bus, f) for bus, time, _, f in listener.heard if time > 202_000_000]
    assert {f.id for bus, f in late if bus == 1} == {0x001}
    assert {f.id & 0x780 for bus, f in late if bus == 0} >= {messages.STATE, messages.COMMAND}
    assert missed(outcome) > 200 * 3


def test_a_babbler_with_a_drives_identifier_is_taken_for_it(clean: Outcome) -> None:
    """Its reports are all zero: the statusword of a drive that is not ready."""
    knee = messages.STATE + description.load("hume").joint("left_knee").node_id
    outcome, listener, _ = hung(
        f"bus.left_leg.babble.identifier={knee}", "bus.left_leg.babble.length=24", "bus.left_leg.babble.rate=1500Hz",
    )  # fmt: skip
    assert sum(f == Frame(knee, bytes(24)) for _, _, _, f in listener.heard) > 300
    drives = outcome.tables["drives"]["statusword.left_knee"]
    assert drives[-1] != 0  # the drive's own word is still known by the port that it comes from
    assert (outcome.tables["controller"]["q.left_knee"] != clean.tables["controller"]["q.left_knee"]).any()


def test_a_drive_set_up_with_anothers_node_id_sends_in_its_name() -> None:
    robot = description.load("hume")
    knee, hip = robot.joint("left_knee"), robot.joint("left_hip")
    outcome, listener, system = hung(f"bus.left_leg.node.left_hip.node_id={knee.node_id}")
    senders = Counter((sender, f.id) for bus, _, sender, f in listener.heard if bus == 1)
    ports = {name: port for port, name in enumerate(robot.buses[1].joints, start=1)}
    states = [senders[ports[name], messages.STATE + knee.node_id] for name in ("left_hip", "left_knee")]
    assert states[0] == pytest.approx(states[1], abs=1) and states[0] > 500
    assert not any(f.id & 0x7F == hip.node_id and f.id != messages.COMMAND for _, _, _, f in listener.heard)
    assert system.wires[1].collisions > 500
    assert outcome.tables["controller"]["phase"][-1] == 0  # one drive was never heard of


def counters(listener: Listener, node_id: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and numbers of a drive's reports."""
    found = [(t, f.data[0] | f.data[1] << 8) for _, t, _, f in listener.heard if f.id == messages.STATE + node_id]
    return np.array([t for t, _ in found]), np.array([c for _, c in found])


@pytest.mark.parametrize("ppm", [20_000, -20_000])
def test_a_drifting_drive_reports_at_the_rate_of_its_own_clock(ppm: int) -> None:
    outcome, listener, _ = hung(f"bus.left_leg.node.left_knee.drift={ppm}ppm")
    robot = description.load("hume")
    own, others = (counters(listener, robot.joint(name).node_id) for name in ("left_knee", "left_hip"))
    for (times, numbers), rate in ((own, 1500 * (1 + 1e-6 * ppm)), (others, 1500)):
        assert (np.diff(numbers) == 1).all()
        assert (len(times) - 1) / (times[-1] - times[0]) * 1e9 == pytest.approx(rate, rel=2e-3)
    gaps = np.diff(own[0])  # evenly spaced but for the wait for the bus
    assert np.median(gaps) == pytest.approx(1e9 / 1500 / (1 + 1e-6 * ppm), rel=5e-3)
    trips = round_trips(outcome, "left_knee")
    assert len(trips) > 300 and trips.min() > 0.2e-3 and trips.max() < 3e-3  # dated by its own clock


class FakeWire:
    """Notes what is asked of it."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        if name not in ("cut", "stuck_dominant", "listen_only", "one_shot", "bit_rate_error", "restart", "damage"):
            raise AttributeError(name)
        return lambda *args, **kwargs: self.calls.append((name, *args, *kwargs.items()))


def test_faults_of_the_physical_layer_are_the_wires() -> None:
    wire: Any = FakeWire()
    knee = "bus.left_leg.node.left_knee"
    setters = {knee: NodeSetter(wire, 3, None, None), "bus.left_leg": partial(set_wire, wire)}
    scenario = load("stand", [f"{knee}.cut=true", "bus.left_leg.damage=0x182 crc:3", "inject=[{at='1s', until='2s', "
                              f"key='{knee}.bit_rate', value=1.02}}]"])  # fmt: skip
    injector = Injector(scenario, description.load("hume"), setters, Journal(None))
    for key, value in (("stuck_dominant", "true"), ("restart", True), ("one_shot", True), ("listen_only", False)):
        injector.inject(5, f"{knee}.{key}", value)
    injector.inject(6, "bus.left_leg.damage", "0x1ABCDEF 17 5")
    injector.inject(7, "bus.left_leg.damage", "")
    injector.apply_due(10**9 - 1)
    injector.apply_due(10**9)
    injector.apply_due(2 * 10**9)
    assert wire.calls == [
        ("damage", 0x182, 1, "crc:3", ("extended", False)), ("cut", 3, True, 0), ("stuck_dominant", 3, True, 5),
        ("restart", 3, 5), ("one_shot", 3, True, 5), ("listen_only", 3, False, 5),
        ("damage", 0x1ABCDEF, 5, 17, ("extended", True)),
        ("bit_rate_error", 3, 1.02, 10**9), ("bit_rate_error", 3, 1.0, 2 * 10**9),
    ]  # fmt: skip
    with pytest.raises(UserError, match="nothing to inject"):
        injector.inject(5, f"{knee}.drift", "5ppm")


def test_an_injection_with_an_end_returns_to_the_value_before() -> None:
    outcome, _, _ = hung(
        "bus.left_leg.loss=0.01",
        "inject=[{at='0.1s', until='0.2s', key='bus.left_leg.loss', value=0.25}, "
        "{at='0.2s', until='0.3s', key='bus.left_leg.loss', value=0.1}]",
    )  # fmt: skip
    assert [(e["value"], e["by"]) for e in outcome.record["injected"]] == [
        (value, "scenario") for value in (0.25, 0.01, 0.1, 0.01)
    ]
    times = [e["time_ns"] for e in outcome.record["injected"]]
    assert all(0 <= t - at < 1e9 / 1500 for t, at in zip(times, (1e8, 2e8, 2e8, 3e8), strict=True))
    lost, sent = outcome.tables["bus"]["lost.left_leg"], outcome.tables["bus"]["sent.left_leg"]
    at = [int(np.searchsorted(outcome.tables["bus"].times, t * 1e8)) for t in (1, 2, 3)]
    share = np.diff(lost[at]) / np.diff(sent[at])
    assert share[0] == pytest.approx(0.25, abs=0.06) and share[1] == pytest.approx(0.1, abs=0.05)
    assert (lost[-1] - lost[at[2] + 1]) / (sent[-1] - sent[at[2] + 1]) < 0.05
    assert outcome.record["reproducible_from"] == "scenario"


EVERYTHING = [
    *(f"{path}.{value}" for path in ("link.state", "link.command", "bus.left_leg", "bus.right_leg") for value in (
        "delay=20us", "jitter=30us", "loss=0.005", "burst.enter=0.002", "burst.leave=0.5", "bit_error_rate=1e-5",
        "corruption=0.001", "duplicate=0.02", "reorder=0.01")),
    "link.state.jitter_shape=exponential", "link.command.jitter_shape=normal", "bus.left_leg.jitter_shape=pareto",
    "bus.right_leg.jitter_shape=lognormal", "bus.left_leg.babble.rate=300Hz", "bus.left_leg.background.load=0.1",
    "bus.right_leg.background.load=0.1", "bus.right_leg.background.pattern=poisson",
    "bus.left_leg.node.left_knee.drift=3000ppm", "bus.right_leg.node.right_hip.drift=-4000ppm",
    "inject=[{at='0.3s', until='0.35s', key='bus.left_leg.node.left_hip.node_id', value=6}, "
    "{at='0.2s', until='0.2015s', key='bus.left_leg.babble.rate', value='50kHz'}, "
    "{at='0.25s', key='bus.right_leg.node.right_knee.drift', value='2000ppm'}]",
]  # fmt: skip


def test_all_faults_at_once_give_one_digest_on_both_backends() -> None:
    inline, _, system = hung(*EVERYTHING)
    for wire in system.wires:
        assert all(wire.counts[what] for what in ("sent", "lost", "errors", "duplicated", "corrupted", "reordered"))
    assert len(inline.record["injected"]) == 5
    assert inline.record["simulated_time"] == 0.4
    assert hung(*EVERYTHING)[0].record["log_digest"] == inline.record["log_digest"]
    assert hung(*EVERYTHING, backend="processes")[0].record["log_digest"] == inline.record["log_digest"]


@pytest.mark.parametrize("backend", ["inline", "processes"])
def test_a_run_with_all_faults_is_restored(backend: str) -> None:
    request = Request(load("stand", [*HUNG, *EVERYTHING]), seed=5, backend=backend)
    with assemble(request) as assembly:
        system = assembly.system
        system.run_until(260_000_000)
        saved = system.snapshot()
        system.run_until(400_000_000)
        world, bus = (assembly.recorder.table(n) for n in ("world", "bus"))
    with assemble(request) as assembly:
        assembly.system.run_until(310_000_000)
        began = len(assembly.recorder.table("world"))
        assembly.system.restore(saved)
        assembly.system.run_until(400_000_000)
        again, bus_again = (assembly.recorder.table(n) for n in ("world", "bus"))
    rows = len(again) - began
    assert rows > 200
    assert (again.data[-rows:] == world.data[-rows:]).all()
    assert (bus_again.data[-13:] == bus.data[-13:]).all()


def test_every_injectable_key_takes_effect_in_a_run(tmp_path: Path) -> None:
    """None of the registry's keys is without somebody who takes it."""
    request = Request(load("stand", HUNG), backend="inline", out=tmp_path / "run", report=False)
    with assemble(request) as assembly:
        keys = injectable(description.load("hume"))
        for key, entry in keys.items():
            value = entry.written(entry.default)
            assert assembly.system.inject(key, value) == parse_value(key, value)
        with pytest.raises(UserError):
            assembly.system.inject("duration", "1s")
        assembly.system.run_until(10_000_000)
        assert assembly.system.reproducible_from == "record"
    lines = [json.loads(line) for line in (tmp_path / "run" / "journal.jsonl").read_text().splitlines()]
    assert [e["key"] for e in lines if "key" in e] == [e["key"] for e in assembly.system.injected]
