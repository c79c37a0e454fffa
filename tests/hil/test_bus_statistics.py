"""Waiting times in run.json and in the report, beside their bounds."""

from types import SimpleNamespace
from typing import Any, NamedTuple

from bus.config import BusConfig
from bus.frames import Frame
from bus.link import NEVER
from bus.wire import Wire
from hil.bus_statistics import bus_statistics, statistics_table
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
        assert len(rows) == 7  # command, three states, three heartbeats
        assert all(row["wait_max"] <= row["wait_bound"] for row in rows.values())
        assert sum(name.endswith("state") and row["sent"] == 450 for name, row in rows.items()) == 3
    assert "beyond" not in statistics_table(record["bus"])


class Wait(NamedTuple):
    frames: int
    longest: int

    def percentile(self, q: int) -> int:
        return 1000 * q


class FakeWire:
    errors = 2

    def __init__(self, waits: dict[tuple[int, bool], Any]) -> None:
        self.waits = lambda: waits


def test_foreign_frames_errors_and_waits_beyond_the_bound_stand_out() -> None:
    waits = {(0x181, False): Wait(10, 10**9), (0x777, False): Wait(1, 5)}
    found = bus_statistics([FakeWire(waits), FakeWire({})], SCENARIO)
    right = found["right_leg"]
    assert right["other_traffic"] and right["identifiers"][1]["name"] is None
    assert (right["identifiers"][0]["wait_p50"], right["identifiers"][0]["wait_p99"]) == (50e-6, 99e-6)
    page = statistics_table(found)
    assert page.count("class=beyond") == 1 and "2 errors and other traffic, which the bounds do not count" in page
    assert ">other<" in page and ">99.0<" in page


def test_lost_and_repeated_frames_are_counted_where_the_wire_counts_them() -> None:
    wire, other = FakeWire({}), FakeWire({(0x181, False): Wait(7, 5)})
    one = SimpleNamespace(sent=9, lost=2, retransmitted=3, wait=Wait(9, 5))
    wire.traffic = lambda: {(0x181, False): one}  # type: ignore[attr-defined]
    counting = bus_statistics([wire, other], SCENARIO)["right_leg"]["identifiers"][0]
    assert [counting[key] for key in ("sent", "lost", "retransmitted")] == [9, 2, 3]
    silent = bus_statistics([other, wire], SCENARIO)["right_leg"]["identifiers"][0]
    assert [silent[key] for key in ("sent", "lost", "retransmitted")] == [7, None, None]


def test_the_wires_own_statistics_are_understood() -> None:
    wire = Wire("right_leg", BusConfig(), 2, streams(1))
    for port, identifier in ((0, 0x181), (1, 0x182)):
        wire.offer(0, port, Frame(identifier, bytes(24)))
    while wire.next_time() < NEVER:
        wire.advance(wire.next_time())
    both = bus_statistics([wire, FakeWire({})], SCENARIO)["right_leg"]["identifiers"]
    assert [row["sent"] for row in both] == [1, 1]
    assert both[0]["wait_max"] == 0.0 < both[1]["wait_max"] <= both[0]["frame"]
