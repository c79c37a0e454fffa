"""The clock of a joint whose oscillator is off."""

from __future__ import annotations

from typing import Any


class DriftingClock:
    """When a node ticks whose clock runs fast by ``ppm`` parts per million (slow when negative).

    The node's tick j happens at its own time, between two ticks of the world; its frames are sent at that time to the
    nanosecond. What it reads from its pins is the sample of the world's tick at or before, so up to one tick old.
    Once in 10^6/ppm ticks a fast node ticks twice within one tick of the world, a slow one not at all: counters,
    watchdogs and reports of the node run at the rate of its own clock.
    """

    def __init__(self, period_ns: float, ticks: int) -> None:
        self._period = period_ns  # of the world's ticks
        self._own_period = period_ns
        self._phase = 0.0  # of the node's next tick after the world's next tick, ns
        self._ticks = ticks  # the node's own, so far
        self._last_ns = (ticks - 1) * period_ns  # time of the last of these

    def set(self, ppm: float) -> None:
        """Change the drift; the phase that has built up stays."""
        self._own_period = self._period / (1.0 + 1e-6 * ppm)

    def offsets(self, now_ns: int) -> list[int]:
        """After the world's tick at ``now_ns``: when the node ticks before the world's next tick, ns after it."""
        offsets = []
        while self._phase < self._period:
            offsets.append(int(self._phase))
            self._ticks += 1
            self._last_ns = now_ns + self._phase
            self._phase += self._own_period
        self._phase -= self._period
        return offsets

    def sampled_ns(self, counter: int, ticks_per_report: int) -> float | None:
        """Time of the node's latest report whose number is ``counter`` modulo 2**16; None if it was before time 0."""
        latest = (self._ticks - 1) // ticks_per_report
        report = latest - ((latest - counter) & 0xFFFF)
        time = self._last_ns - (self._ticks - 1 - report * ticks_per_report) * self._own_period
        return time if report >= 0 else None

    def snapshot(self) -> Any:
        return self._own_period, self._phase, self._ticks, self._last_ns

    def restore(self, state: Any) -> None:
        self._own_period, self._phase, self._ticks, self._last_ns = state
