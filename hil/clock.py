"""Clocks: virtual time runs as fast as it can; wall time is paced against the monotonic clock."""

from __future__ import annotations

import os
import time

import numpy as np

_SPIN_NS = 150_000  # the kernel wakes a sleeper this much too late at times: sleep short, then spin


def tick_ns(k: int, rate: int) -> int:
    """Time of tick ``k`` of a node at ``rate`` hertz, ns: no drift from rates that do not divide a second."""
    return k * 1_000_000_000 // rate


class VirtualClock:
    """Time goes on as soon as everything that belongs to it is done."""

    name = "virtual"

    def start(self) -> None:
        pass

    def wait_until(self, time_ns: int) -> None:
        pass

    def report(self) -> dict[str, object] | None:
        return None


class WallClock:
    """Absolute deadlines on the monotonic clock. A late event runs at once, and the lateness is counted."""

    name = "wall"
    EDGES_US = (0, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 100_000, 1_000_000)

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns  # an event later than this has missed its deadline
        self._origin = 0
        self._lateness_us: list[float] = []
        self.scheduling = "default"

    def request_priority(self) -> None:
        """Ask for real-time scheduling of this process and of those it will fork."""
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
            self.scheduling = "SCHED_FIFO"
        except (PermissionError, OSError):
            self.scheduling = "default (SCHED_FIFO not permitted)"

    def start(self) -> None:
        """Let time 0 be now."""
        self._origin = time.monotonic_ns()

    def wait_until(self, time_ns: int) -> None:
        """Return at ``time_ns`` after the start, or at once when that has passed."""
        deadline = self._origin + time_ns
        ahead = deadline - time.monotonic_ns()
        if ahead > _SPIN_NS:
            time.sleep((ahead - _SPIN_NS) * 1e-9)
        while (now := time.monotonic_ns()) < deadline:
            pass
        self._lateness_us.append((now - deadline) * 1e-3)

    def report(self) -> dict[str, object]:
        """Lateness of all ticks: histogram, percentiles (µs), and the share that missed its deadline."""
        lateness = np.asarray(self._lateness_us or [0.0])
        counts, _ = np.histogram(lateness, bins=[*self.EDGES_US, np.inf])
        p50, p99 = np.percentile(lateness, [50, 99])
        missed = float(np.mean(lateness > self._period_ns * 1e-3))
        return {
            "scheduling": self.scheduling,
            "ticks": len(lateness),
            "lateness_p50_us": round(float(p50), 1),
            "lateness_p99_us": round(float(p99), 1),
            "lateness_max_us": round(float(lateness.max()), 1),
            "missed_share": missed,
            "period_us": self._period_ns * 1e-3,
            "slipped_s": round(float(lateness[-1]) * 1e-6, 4),
            "histogram": {
                f"{low} µs and more" if i == len(self.EDGES_US) - 1 else f"{low}–{self.EDGES_US[i + 1]} µs": int(n)
                for i, (low, n) in enumerate(zip(self.EDGES_US, counts, strict=True))
            },
            "kept_up": missed < 0.01 and bool(lateness[-1] < 1e4),
        }
