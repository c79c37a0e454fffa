"""Waiting times in run.json and in the report, beside their bounds."""

from bus.config import BusConfig
from bus.frames import Frame
from bus.link import NEVER
from bus.traffic import Traffic
from bus.wire import Wire
from hil.analysis.bus_statistics import bus_statistics, statistics_table
from hil.run import Request, run
from hil.scenario import load
from hil.streams import streams

SCENARIO = load("stand", ["duration=0.3s"])


def test_a_run_records_each_identifier_within_its_bound() -> None:
    record = run(Request(SCENARIO, seed=1, backend="inline")).record
    assert set(record["bus"]) == {"left_leg", "right_leg"}
    for bus in record["bus"].values():
        assert not bus["other_traffic"] and bus["errors"] == 0
        rows = {row["name"]: row for row in bus["identifiers"]}
        assert len(rows) == 7  # command, three states from the end of their boot on, three heartbeats
        assert all(row["wait_max"] <= row["wait_bound"] for row in rows.values())
        assert sum(name.endswith("state") and row["sent"] == 419 for name, row in rows.items()) == 3
    assert "beyond" not in statistics_table(record["bus"])


class FakeWire:
    errors = 2

    def __init__(self, waits: dict[int, list[int]]) -> None:
        self._traffic = {}
        for identifier, times in waits.items():
            one = self._traffic[identifier, False] = Traffic()
            for time in times:
                one.note_sent(time)

    def traffic(self) -> dict[tuple[int, bool], Traffic]:
        return self._traffic


def test_foreign_frames_errors_and_waits_beyond_the_bound_stand_out() -> None:
    waits = {0x181: [*range(1000, 100_000, 1000), 10**9], 0x777: [5]}
    found = bus_statistics([FakeWire(waits), FakeWire({})], SCENARIO)
    right = found["right_leg"]
    assert right["other_traffic"] and right["identifiers"][1]["name"] is None
    first = right["identifiers"][0]
    assert 50e-6 <= first["wait_p50"] <= 50e-6 * 17 / 16 and 99e-6 <= first["wait_p99"] <= 99e-6 * 17 / 16
    page = statistics_table(found)
    assert page.count("class=beyond") == 1 and "2 errors and other traffic, which the bounds do not count" in page
    assert ">other<" in page and ">1000000.0<" in page


def test_the_wires_own_statistics_are_understood() -> None:
    wire = Wire("right_leg", BusConfig(), 2, streams(1))
    for port, identifier in ((0, 0x181), (1, 0x182)):
        wire.offer(0, port, Frame(identifier, bytes(24)))
    while wire.next_ns < NEVER:
        wire.advance(wire.next_ns)
    both = bus_statistics([wire, FakeWire({})], SCENARIO)["right_leg"]["identifiers"]
    assert [[row[key] for key in ("sent", "lost", "retransmitted")] for row in both] == [[1, 0, 0]] * 2
    assert both[0]["wait_max"] == 0.0 < both[1]["wait_max"] <= both[0]["frame"]
