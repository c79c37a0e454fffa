"""Clocks: virtual time runs as fast as it can; wall time is paced against the monotonic clock."""

from __future__ import annotations

import os
import time

from hil.lateness import Lateness

_SPIN_NS = 150_000  # the kernel wakes a sleeper this much too late at times: sleep short, then spin


def tick_ns(k: int, rate: int) -> int:
    """Time of tick ``k`` of a node at ``rate`` hertz, ns: no drift from rates that do not divide a second."""
    return k * 1_000_000_000 // rate


def request_priority() -> str:
    """Ask for real-time scheduling of this process and of those it will fork; returns what it got."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
        return "SCHED_FIFO"
    except OSError:
        return "default (SCHED_FIFO not permitted)"


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

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns  # an event later than this has missed its deadline
        self._origin = 0
        self._lateness = Lateness()
        self._missed = 0
        self.scheduling = "default"

    def request_priority(self) -> None:
        """Ask for real-time scheduling of this process and of those it will fork."""
        self.scheduling = request_priority()

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
        self._lateness.add(now - deadline)
        if now - deadline > self._period_ns:
            self._missed += 1

    def report(self) -> dict[str, object]:
        """Lateness of all ticks: histogram, percentiles (µs), and the share that missed its deadline."""
        lateness = self._lateness
        missed = self._missed / max(lateness.events, 1)
        return {
            "scheduling": self.scheduling,
            "ticks": lateness.events,
            "lateness_p50_us": round(lateness.percentile_us(50), 1),
            "lateness_p99_us": round(lateness.percentile_us(99), 1),
            "lateness_max_us": round(lateness.longest_ns * 1e-3, 1),
            "missed_share": missed,
            "period_us": self._period_ns * 1e-3,
            "slipped_s": round(lateness.last_ns * 1e-9, 4),
            "histogram": lateness.histogram(),
            "kept_up": missed < 0.01 and lateness.last_ns < 10_000_000,
        }
