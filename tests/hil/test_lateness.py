"""The histogram of lateness against NumPy's percentiles of the same numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.lateness import Lateness


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=200), st.floats(0, 100))
def test_percentiles_are_those_of_the_numbers(numbers: list[int], percent: float) -> None:
    lateness = Lateness()
    for ns in numbers:
        lateness.add(ns)
    expected = float(np.percentile(numbers, percent, method="inverted_cdf")) * 1e-3
    # exact to a bucket, never optimistic
    assert expected * 0.999999 <= lateness.percentile_us(percent) <= expected * (1 + 1 / 128) + 0.001
    assert (lateness.events, lateness.longest_ns, lateness.last_ns) == (len(numbers), max(numbers), numbers[-1])


@given(st.lists(st.integers(0, 10**10), max_size=100))
def test_the_histogram_counts_every_event_once(numbers: list[int]) -> None:
    lateness = Lateness()
    for ns in numbers:
        lateness.add(ns)
    counts = lateness.histogram()
    assert sum(counts.values()) == len(numbers)
    assert counts["1000000 µs and more"] == pytest.approx(sum(n >= 1.01e9 for n in numbers), abs=sum(
        0.99e9 < n < 1.01e9 for n in numbers))  # fmt: skip


def test_without_events_there_is_nothing_to_report_and_early_is_not_late() -> None:
    lateness = Lateness()
    assert lateness.summary() == {"events": 0, "p50_us": 0.0, "p99_us": 0.0, "max_us": 0.0}
    lateness.add(-5)
    assert lateness.longest_ns == 0 and lateness.events == 1
