"""What became of the frames of one identifier: counts, and how long they waited for the bus."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

_FINE = 5  # bits that a bucket of the histogram resolves: buckets are at most 1/16 wide
_RECENT = 256


class Wait(NamedTuple):
    """How long the frames of one identifier waited for the bus, ns, until the attempt that got through started."""

    frames: int
    shortest: int
    mean: float
    longest: int
    buckets: tuple[tuple[int, int], ...] = ()  # of the histogram: number, frames

    def percentile(self, percent: float) -> int:
        """Waiting time in ns that ``percent`` of the frames do not exceed, at most 1/16 too large; 0 without frames."""
        left = percent * self.frames / 100
        for bucket, frames in self.buckets:
            left -= frames
            if left <= 0:
                shift, mantissa = bucket >> _FINE, bucket & (1 << _FINE) - 1
                return min((mantissa + 1 << shift) - 1, self.longest)
        return self.longest


class Traffic:
    """Frames of one identifier.

    sent: that got through. lost: that got through and vanished (an impairment), or were given up in one-shot mode.
    retransmitted: attempts that failed and were repeated. Waiting times fall into buckets of 1/16 relative width.
    """

    __slots__ = ("_buckets", "_counted", "_longest", "_recent", "_shortest", "_sum", "lost", "retransmitted")

    def __init__(self) -> None:
        self.lost = self.retransmitted = 0
        self._counted = self._sum = self._longest = 0
        self._shortest = 1 << 62
        self._buckets: dict[int, int] = {}
        self._recent: list[int] = []  # waiting times that are not counted yet: many at once take less

    def note_sent(self, wait: int) -> None:
        """One more frame that got through, after ``wait`` ns."""
        self._recent.append(wait)
        if len(self._recent) >= _RECENT:
            self._count()

    def _count(self) -> None:
        buckets = self._buckets
        for wait, frames in Counter(self._recent).items():
            self._counted += frames
            self._sum += frames * wait
            if wait > self._longest:
                self._longest = wait
            if wait < self._shortest:
                self._shortest = wait
            bucket = wait
            if wait >> _FINE:
                shift = wait.bit_length() - _FINE
                bucket = shift << _FINE | wait >> shift
            buckets[bucket] = buckets.get(bucket, 0) + frames
        self._recent.clear()

    @property
    def sent(self) -> int:
        return self._counted + len(self._recent)

    @property
    def wait(self) -> Wait:
        """Of the frames that got through; all zero when there is none."""
        self._count()
        if not self._counted:
            return Wait(0, 0, 0.0, 0)
        buckets = tuple(sorted(self._buckets.items()))
        return Wait(self._counted, self._shortest, self._sum / self._counted, self._longest, buckets)

    def snapshot(self) -> tuple[Any, ...]:
        self._count()
        counts = self._counted, self.lost, self.retransmitted
        return (*counts, self._sum, self._shortest, self._longest, dict(self._buckets))

    @classmethod
    def restored(cls, state: tuple[Any, ...]) -> Traffic:
        one = cls()
        one._counted, one.lost, one.retransmitted, one._sum, one._shortest, one._longest, buckets = state
        one._buckets = dict(buckets)
        return one
