"""What a few seeds tell about all: intervals without assumptions on the distribution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy import stats

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """From ``low`` to ``high``, which may be infinite, with this ``confidence`` (0 to 1)."""

    low: float
    high: float
    confidence: float


def median(values: Sequence[float]) -> float:
    """The median, of an even number the lower of the two in the middle: a value that was seen, also beside infinity."""
    return sorted(values)[(len(values) - 1) // 2]


def median_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """Interval for the median of what ``values`` are drawn from, by order statistics.

    The k-th smallest and the k-th largest of n values hold the median between them with a probability of at least
    1 − 2 P(B ≤ k − 1), B binomial (n, ½), whatever the distribution. Taken is the largest k that reaches
    ``confidence``; if none does, k = 1 with the confidence that it has, 1 − 2^(1−n): 0 for one value, 0.875 for four.
    """
    n, ordered = len(values), sorted(values)
    k = max([k for k in range(1, n // 2 + 1) if _coverage(n, k) >= confidence], default=1)
    return Interval(ordered[k - 1], ordered[n - k], _coverage(n, k))


def _coverage(n: int, k: int) -> float:
    return max(0.0, 1.0 - 2.0 * float(stats.binom.cdf(k - 1, n, 0.5)))


def share_interval(count: int, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Clopper and Pearson's interval (1934) for a probability of which ``count`` of ``n`` trials came true."""
    found = stats.binomtest(count, n).proportion_ci(confidence, "exact")
    return Interval(float(found.low), float(found.high), confidence)


def finite(value: float) -> float | None:
    """For JSON: None in place of an infinity."""
    return value if math.isfinite(value) else None
