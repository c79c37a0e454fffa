"""The last seconds of a run at the rate of the physics: kept in a ring, looked at only when the run has failed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.record.signals import Signals

LAST_SECONDS_FILE = "last_seconds.mcap"
CHANNEL = "physics"


class StepRing:
    """Copies of arrays, one row per physics step.

    Args:
        sources: names and views (n,) of what is copied.
        rate: of the steps, Hz.
        seconds: how long a row is kept.
    """

    def __init__(self, sources: Sequence[tuple[Sequence[str], np.ndarray]], rate: float, seconds: float = 2.0) -> None:
        self._names = tuple(name for names, _ in sources for name in names)
        self._rate = round(rate)
        self._rows = np.zeros((max(1, round(rate * seconds)), len(self._names)))
        self._row = list(self._rows)  # views
        self._views = tuple(view for _, view in sources)
        self._next = 0
        self._count = 0  # rows that are of this run

    def append(self) -> None:
        """Copy all sources, after a step."""
        at = self._next
        np.concatenate(self._views, out=self._row[at])
        self._next = at + 1 if at + 1 < len(self._rows) else 0
        self._count += 1

    def clear(self) -> None:
        """Forget all rows: the system was set back, what they tell has not happened."""
        self._next = self._count = 0

    def table(self, steps: int) -> Signals:
        """The rows in time, after step ``steps``: row k is of the time at the end of its step."""
        count = min(self._count, len(self._rows))
        order = (self._next - count + np.arange(count)) % len(self._rows)
        times = np.arange(steps - count + 1, steps + 1, dtype=np.int64) * 1_000_000_000 // self._rate
        return Signals(times, self._names, self._rows[order])
