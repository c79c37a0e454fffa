"""The schedulability table against the emulation itself, and the command that prints it."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

from bus.frames import Frame
from bus.response_time import longest_frame
from bus.timing import BitRates
from hil.analysis.message_set import analyse, as_planned, load_table, traffic
from hil.cli import main
from hil.commands import bus_sweep
from hil.commands.bus_load import background
from hil.commands.bus_sweep import LoadedWire, predict
from hil.errors import UserError
from hil.run import Request, assemble
from hil.scenario import load
from hil.system import Tap
from robots import description

SCENARIO = load("stand", ["link.command.jitter=30us"])
ROBOT = description.load(SCENARIO.robot)


class Listener(Tap):
    """A tap that keeps what it hears."""

    def __init__(self) -> None:
        self.heard: dict[tuple[int, int], list[tuple[int, Frame]]] = defaultdict(list)

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        self.heard[bus, frame.id].append((time_ns, frame))

    def poll(self) -> list[tuple[int, Frame]]:
        return []


def run(wrap: Any = lambda wire: wire) -> tuple[Listener, list[Any]]:
    """A third of a second of the scenario: what was heard, and the wires."""
    listener = Listener()
    with assemble(Request(SCENARIO, seed=2, backend="inline")) as assembly:
        system = assembly.system
        system.tap = listener
        system.wires[:] = [wrap(wire) for wire in system.wires]
        system.run_until(330_000_000)
        return listener, system.wires


def test_a_run_sends_what_the_table_lists_and_waits_no_longer_than_it_says() -> None:
    listener, wires = run()
    for b, (bus, wire) in enumerate(zip(ROBOT.buses, wires, strict=True)):
        sent = traffic(SCENARIO, ROBOT, bus)
        listed = {t.identifier: t for t in sent}
        periodic = {t.identifier for t in sent if t.offset is not None}
        assert periodic == {identifier for at, identifier in listener.heard if at == b}
        for identifier in periodic:
            t, heard = listed[identifier], listener.heard[b, identifier][1:]  # the first may announce the node
            assert {len(frame.data) for _, frame in heard} == {t.length}
            spacing = (heard[-1][0] - heard[0][0]) / (len(heard) - 1)
            assert abs(spacing - t.period) < 1e-3 * t.period and spacing * (len(heard) + 1) > 0.9 * 330e6 - t.period
        waits = wire.waits()
        bounds = {r.message.name: r for r in analyse(sent, SCENARIO.bus[bus.name])}
        for identifier in periodic:
            bound = bounds[listed[identifier].name]
            assert bound.from_queue is not None
            assert waits[identifier, False].longest <= bound.from_queue - bound.message.frame


def test_without_jitter_the_drives_states_wait_as_planned() -> None:
    """The first state never waits; each of the others waits for those before it, all as long as they can be."""
    for bus in ROBOT.buses:
        sent, config = traffic(SCENARIO, ROBOT, bus), SCENARIO.bus[bus.name]
        planned = as_planned(sent, config)
        bounds = {r.message.name: r for r in analyse(sent, config)}
        states = [t for t in sent if t.name.endswith("state")]
        frames = [bounds[t.name].message.frame for t in states]
        assert [planned[t.name] for t in states] == [sum(frames[: n + 1]) for n in range(len(frames))]
        assert planned["command"] == bounds["command"].message.frame
        assert not any("emergency" in name for name in planned)


def test_a_loaded_wire_sends_the_background_and_stays_within_the_bounds() -> None:
    extra = background("0x010:64:500us")
    frame = longest_frame(extra.identifier, extra.length)
    listener, wires = run(lambda wire: LoadedWire(wire, frame, extra.period, 0))
    predicted = predict(SCENARIO, extra)["waited"]
    for b, (bus, wire) in enumerate(zip(ROBOT.buses, wires, strict=True)):
        assert len(listener.heard[b, 0x010]) == 660
        waits = wire.waits()
        listed = [t for t in traffic(SCENARIO, ROBOT, bus) if t.offset is not None]
        slowest = {kind: max(waits[t.identifier, False].longest for t in listed if t.name.endswith(kind))
                   for kind in ("state", "command", "heartbeat")}  # fmt: skip
        assert all(1e-9 * wait <= predicted[kind] for kind, wait in slowest.items())
        assert slowest["command"] > 0.5 * extra.message(BitRates(1e6, 5e6)).frame  # it does get in the way


def test_the_round_trip_is_predicted_from_its_parts() -> None:
    """On a bus without any other traffic worth mentioning: tick, computation, and one command, by hand."""
    scenario = load("stand", ["firmware.report_rate=100Hz", "controller.rate=100Hz", "controller.phase=5ms",
                              "firmware.watchdog=50ms", "link.command.delay=1ms"])  # fmt: skip
    table = load_table(scenario)
    command = max(row["response"] for bus in table["buses"].values() for row in bus["messages"]
                  if row["name"] == "command")  # fmt: skip
    emergencies = 3 * max(row["frame"] for bus in table["buses"].values() for row in bus["messages"][:3])
    predicted = predict(scenario, None)["round_trip"]
    assert predicted == pytest.approx(0.005 + 200e-6 + 0.001 + command - emergencies, abs=2e-6)


def test_extended_identifiers_rank_behind_base_ones_of_the_same_first_bits() -> None:
    rates = BitRates(1e6, 5e6)
    texts = ("0x200:0:1ms", f"{0x200 << 18:#x}:0:1ms", f"{0x200 << 18 | 1:#x}:0:1ms", "0x201:0:1ms")
    orders = [background(text).message(rates).order for text in texts]
    assert orders == sorted(orders)


# --- the command ----------------------------------------------------------------------------------------------


def test_the_command_prints_the_table_and_answers_with_its_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bus", "load", "split-terrain"]) == 0
    text = capsys.readouterr().out
    assert "left_leg, 1/5 Mbit/s: schedulable" in text and "0x200 command" in text
    assert main(["bus", "load", "split-terrain", "--with", "0x010:64:350us", "--json"]) == 1
    table = json.loads(capsys.readouterr().out)
    assert not table["schedulable"]
    for bus in table["buses"].values():
        rows = {row["name"]: row for row in bus["messages"]}
        assert bus["utilisation"] == pytest.approx(sum(r["frame"] / r["period"] for r in rows.values()))
        assert bus["utilisation"] > 1
        assert rows["command"]["response"] is None and rows["command"]["slack"] is None
        assert rows["background 0x010"]["schedulable"]
        for row in rows.values():
            assert row["slack"] is None or row["slack"] == pytest.approx(row["deadline"] - row["response"])


def test_a_classical_frame_is_counted_by_its_published_length(capsys: pytest.CaptureFixture[str]) -> None:
    """An SDO of a stock CANopen master: 135 bits at 1 Mbit/s, behind the command and thus blocking it. With an
    emergency of every drive at the same time that is too much."""
    assert main(["bus", "load", "stand", "--with", "0x601:8:5ms:classic", "--json"]) == 1
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["buses"]["left_leg"]["messages"]}
    assert rows["background 0x601"]["frame"] == rows["command"]["blocking"] == pytest.approx(135e-6)


def test_faults_and_slower_rates_are_worse() -> None:
    def command(*settings: str, faults: int | None = None) -> float:
        table = load_table(load("stand", settings), fault_interval=faults)
        return next(r["response"] for r in table["buses"]["left_leg"]["messages"] if r["name"] == "command")

    plain = command()
    assert command(faults=10_000_000) > plain
    assert command("bus.left_leg.data_rate=2Mbit/s", "controller.rate=500Hz", "firmware.report_rate=500Hz") > plain


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["load", "stnd"], "no scenario 'stnd'; did you mean 'stand'? (a file of your own ends in .toml)"),
        (["load", "stand", "--with", "0x10:8"],
         "--with 0x10:8: expected IDENTIFIER:BYTES:PERIOD or IDENTIFIER:BYTES:PERIOD:classic, e.g. 0x050:8:1ms"),
        (["load", "stand", "--with", "0x10:12:1ms:classic"],
         "--with 0x10:12:1ms:classic: expected a number of bytes of 0, 1, 2, 3, 4, 5, 6, 7, 8"),
        (["load", "stand", "--with", "0x20000000:8:1ms"],
         "--with 0x20000000:8:1ms: expected an identifier from 0 to 0x1fffffff, for example 0x050"),
        (["load", "stand", "--with", "16:9:1ms"],
         "--with 16:9:1ms: expected a number of bytes of 0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64"),
        (["load", "stand", "--with", "16:8:1"],
         "--with 16:8:1: '1' has no unit: write one of s, ms, us, µs, ns"),
        (["load", "stand", "--with", "16:8:0"], "--with 16:8:0: expected a time from 1us to 3600s"),
        (["load", "stand", "--faults", "1ns"], "--faults 1ns: expected a time from 1us to 3600s"),
        (["load", "stand", "--with", "16:8:1ms", "--with", "0x10:8:2ms"],
         "--with 0x10:8:2ms: another --with has this identifier already"),
        (["load", "stand", "--with", "0x200:8:1ms"],
         "--with 0x200:8:1ms: the command has this identifier already"),
        (["sweep-load", "stand", "--bytes", "9"],
         "--bytes 9: expected one of 0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64"),
        (["sweep-load", "stand", "--out", "a/b/c.png"],
         "--out a/b/c.png: expected a file that ends in .png, in a directory that is there"),
        (["sweep-load", "stand", "--seed", "-1"], "--seed -1: expected 0, 1, 2 …"),
    ],
)  # fmt: skip
def test_mistakes_get_one_sentence(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["bus", *arguments]) == 2
    assert capsys.readouterr().err == f"hil: {sentence}\n"


def test_background_is_refused_as_an_error_of_the_user() -> None:
    with pytest.raises(UserError):
        background("x:8:1ms")


def test_the_sweep_draws_what_it_has_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import matplotlib.image

    monkeypatch.setattr(bus_sweep, "_SHARES", (0.0, 0.3, 0.6))
    path = tmp_path / "sweep.png"
    command = ["bus", "sweep-load", "stand", "--duration", "0.2s", "--set", "limits.settle=0.05s", "--out", str(path)]
    assert main([*command, "--json"]) == 0
    points = json.loads(capsys.readouterr().out)
    assert [(p["identifier"], p["share"]) for p in points] == [(i, s) for i in (0x010, 0x7F0) for s in (0.0, 0.3, 0.6)]
    for point in points:
        for kind, waited in point["measured"]["waited"].items():
            bound = point["predicted"]["waited"][kind]
            assert bound is None or waited <= bound
    flooded = points[2]
    assert flooded["predicted"]["waited"]["command"] is None  # 60 % before everything: nothing is left for it
    assert flooded["measured"]["waited"]["state"] > points[1]["measured"]["waited"]["state"]
    assert points[5]["predicted"]["waited"]["command"] is not None  # behind everything it only blocks
    assert matplotlib.image.imread(path).shape[:2] > (500, 500)
