"""How late events were, for as long as it takes: a histogram of fixed size, whatever the number of events.

Buckets are 1/128 of their power of two wide (as in an HDR histogram): a percentile is exact to 0.8 %.
"""

from __future__ import annotations

_FINE = 7  # bits that are kept
_BUCKETS = (64 - _FINE) << _FINE
EDGES_US = (0, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 100_000, 1_000_000)


def _bucket(ns: int) -> int:
    shift = max(ns.bit_length() - _FINE - 1, 0)
    return (shift << _FINE) + (ns >> shift)


def _lowest(bucket: int) -> int:
    """The smallest lateness in a bucket, ns."""
    shift = max((bucket >> _FINE) - 1, 0)
    return (bucket - (shift << _FINE)) << shift


class Lateness:
    """Counts of lateness in ns."""

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self.events = 0
        self.longest_ns = 0
        self.last_ns = 0

    def add(self, ns: int) -> None:
        """Count one event that was ``ns`` late (0 when it was early)."""
        if ns < 0:
            ns = 0
        self._counts[_bucket(ns)] += 1
        self.events += 1
        self.last_ns = ns
        if ns > self.longest_ns:
            self.longest_ns = ns

    def percentile_us(self, percent: float) -> float:
        """The lateness that ``percent`` of all events did not exceed, µs; 0 without events."""
        rank, seen = percent / 100 * self.events, 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if count and seen >= rank:
                return min(_lowest(bucket + 1) - 1, self.longest_ns) * 1e-3
        return 0.0

    def histogram(self) -> dict[str, int]:
        """Events by range of lateness."""
        counts = [0] * len(EDGES_US)
        for bucket, count in enumerate(self._counts):
            if count:
                us = _lowest(bucket) * 1e-3
                counts[max(i for i, edge in enumerate(EDGES_US) if edge <= us)] += count
        return {
            f"{low} µs and more" if i == len(EDGES_US) - 1 else f"{low}–{EDGES_US[i + 1]} µs": count
            for i, (low, count) in enumerate(zip(EDGES_US, counts, strict=True))
        }

    def summary(self) -> dict[str, float]:
        """Median, 99th percentile and longest, µs."""
        return {
            "events": self.events,
            "p50_us": round(self.percentile_us(50), 1),
            "p99_us": round(self.percentile_us(99), 1),
            "max_us": round(self.longest_ns * 1e-3, 1),
        }
