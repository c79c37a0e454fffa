"""A drifting clock against exact arithmetic: when it ticks, how often, and what its counters tell."""

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.clock import tick_ns
from hil.node_clock import DriftingClock

RATE = 3000


def ticks(ppm: float, count: int) -> list[list[int]]:
    """Offsets within each of ``count`` ticks of the world."""
    clock = DriftingClock(1e9 / RATE, 0)
    clock.set(ppm)
    return [clock.offsets(tick_ns(k, RATE)) for k in range(count)]


@given(st.floats(-1e5, 1e5), st.integers(1, 400))
@settings(deadline=None)
def test_tick_j_happens_at_its_own_time(ppm: float, count: int) -> None:
    times = [k * Fraction(10**9, RATE) + o for k, offsets in enumerate(ticks(ppm, count)) for o in offsets]
    own = Fraction(10**9, RATE) / (1 + Fraction(ppm) / 10**6)
    for j, time in enumerate(times):
        assert abs(time - j * own) < 2  # ns
    end = count * Fraction(10**9, RATE)
    assert abs(len(times) - end / own) <= 1  # none is left out, none too many


@pytest.mark.parametrize("ppm, extra", [(1000.0, 1), (-1000.0, -1), (0.0, 0)])
def test_a_fast_clock_gains_a_tick_where_it_should(ppm: float, extra: int) -> None:
    offsets = ticks(ppm, 1500)
    assert [len(o) for o in offsets].count(1 + extra) == (2 if extra > 0 else 1 if extra else 1500)
    assert all(0 <= o < 1e9 / RATE for tick in offsets for o in tick)


def test_drift_that_ends_leaves_the_phase_that_has_built_up() -> None:
    clock = DriftingClock(1e9 / RATE, 0)
    clock.set(-500.0)
    for k in range(300):
        clock.offsets(tick_ns(k, RATE))
    clock.set(0.0)
    (first,), (second,) = clock.offsets(tick_ns(300, RATE)), clock.offsets(tick_ns(301, RATE))
    assert first == second == pytest.approx(0.15 * 1e9 / RATE, rel=1e-2)


@given(st.floats(-1e4, 1e4), st.integers(2, 400), st.integers(0, 20))
@settings(deadline=None)
def test_a_report_is_dated_by_the_clock_that_counted_it(ppm: float, count: int, back: int) -> None:
    clock = DriftingClock(1e9 / RATE, 0)
    clock.set(ppm)
    own: list[float] = []
    for k in range(count):
        own += [k * 1e9 / RATE + o for o in clock.offsets(tick_ns(k, RATE))]
    reports = own[::2]  # every second tick is reported
    latest = len(reports) - 1
    if back > latest:
        assert clock.sampled_ns((latest - back) & 0xFFFF, 2) is None
    else:
        sampled = clock.sampled_ns(latest - back, 2)
        assert sampled == pytest.approx(reports[latest - back], abs=3)


def test_a_restored_clock_goes_on_alike() -> None:
    clock = DriftingClock(1e9 / RATE, 7)
    clock.set(3000.0)
    for k in range(50):
        clock.offsets(tick_ns(k, RATE))
    other = DriftingClock(1e9 / RATE, 0)
    other.restore(clock.snapshot())
    for k in range(50, 500):
        assert other.offsets(tick_ns(k, RATE)) == clock.offsets(tick_ns(k, RATE))
    assert other.snapshot() == clock.snapshot()
