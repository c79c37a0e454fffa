"""Clocks: ticks without drift; wall time against deadlines, with every miss counted."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hil.clock
from hil.clock import VirtualClock, WallClock, tick_ns


@given(st.integers(0, 10**9), st.integers(1, 10**6))
def test_ticks_never_drift(k: int, rate: int) -> None:
    time = tick_ns(k, rate)
    assert 0 <= k * 10**9 - time * rate < rate  # less than 1 ns early, never late
    assert tick_ns(rate * k, rate) == k * 10**9


@given(st.integers(0, 10**7), st.sampled_from([(3000, 1500), (3000, 750), (9000, 3000)]))
def test_slow_ticks_fall_on_fast_ones(k: int, rates: tuple[int, int]) -> None:
    fast, slow = rates
    assert tick_ns(k, slow) == tick_ns(k * (fast // slow), fast)


def test_virtual_time_does_not_wait_and_has_nothing_to_report() -> None:
    clock = VirtualClock()
    clock.start()
    clock.wait_until(10**18)
    assert clock.report() is None


class FakeTime:
    """A monotonic clock that passes 1 µs per look, and oversleeps."""

    def __init__(self, oversleep_ns: int = 0) -> None:
        self.now = 5_000_000_000
        self.oversleep_ns = oversleep_ns
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        self.now += 1000
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.slept.append(seconds)
        self.now += round(seconds * 1e9) + self.oversleep_ns


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeTime]:
    time = FakeTime()
    monkeypatch.setattr(hil.clock, "time", time)
    yield time


PERIOD = 333_333


def test_deadlines_are_absolute_and_met(fake: FakeTime) -> None:
    clock = WallClock(PERIOD)
    clock.start()
    origin = fake.now
    for k in range(1, 300):
        clock.wait_until(k * PERIOD)
        assert 0 <= fake.now - origin - k * PERIOD <= 2000  # one look: no error adds up
    report = clock.report()
    assert report["ticks"] == 299 and report["missed_share"] == 0.0 and report["kept_up"]
    assert fake.slept and max(fake.slept) < PERIOD * 1e-9


def test_an_event_that_is_late_runs_at_once_and_is_counted(fake: FakeTime) -> None:
    clock = WallClock(PERIOD)
    clock.start()
    for k in range(100):
        if k == 50:
            fake.now += 2_000_000  # something took the processor for 2 ms
        clock.wait_until(k * PERIOD)
    report = clock.report()
    assert report["missed_share"] == pytest.approx(0.06, abs=0.011)  # it catches up within six periods
    assert 2000 - PERIOD * 1e-3 < report["lateness_max_us"] < 2000
    assert sum(report["histogram"].values()) == report["ticks"] == 100
    assert not report["kept_up"]


def test_a_machine_that_is_too_slow_does_not_keep_up(fake: FakeTime) -> None:
    clock = WallClock(PERIOD)
    clock.start()
    for k in range(200):
        fake.now += 2 * PERIOD  # each tick takes two periods
        clock.wait_until(k * PERIOD)
    report = clock.report()
    assert not report["kept_up"] and report["missed_share"] > 0.9
    assert report["slipped_s"] == pytest.approx(200 * PERIOD * 1e-9, rel=0.05)


def test_a_sleeper_woken_late_is_counted(fake: FakeTime) -> None:
    fake.oversleep_ns = 1_000_000
    clock = WallClock(PERIOD)
    clock.start()
    clock.wait_until(10 * PERIOD)
    assert clock.report()["lateness_max_us"] > 800


def test_a_report_without_ticks_is_whole() -> None:
    assert WallClock(PERIOD).report()["kept_up"]
