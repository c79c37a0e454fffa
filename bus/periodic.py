"""Periodic sending in bus time: the bus's side keeps the time, so a period means the same however fast a run goes."""

from __future__ import annotations

from bus.frames import Frame

_MAX_DUE = 32  # frames of one task that one look can find due


class Task:
    """Frames sent in turn, one every ``period_ns`` from ``now_ns`` on, for ``duration_ns`` (-1: endlessly).

    The k-th is due at the start plus k periods: nothing drifts. It goes out when the bus is next looked after.
    """

    def __init__(self, now_ns: int, period_ns: int, duration_ns: int, frames: list[Frame]) -> None:
        self._period = period_ns
        self._end = None if duration_ns < 0 else now_ns + duration_ns
        self._frames = frames
        self.next_ns = now_ns
        self._turn = 0

    @property
    def finished(self) -> bool:
        return self._end is not None and self.next_ns >= self._end

    def due(self, now_ns: int) -> list[Frame]:
        """What has become due by ``now_ns``, at most ``_MAX_DUE``; what is more is left out."""
        last = now_ns if self._end is None else min(now_ns, self._end - 1)
        count = (last - self.next_ns) // self._period + 1 if last >= self.next_ns else 0
        frames = self._frames
        due = [frames[(self._turn + n) % len(frames)] for n in range(min(count, _MAX_DUE))]
        self._turn = (self._turn + count) % len(frames)
        self.next_ns += count * self._period
        return due

    def exchange(self, frames: list[Frame]) -> None:
        """Send ``frames`` from now on, without a change of the timing."""
        self._frames = frames
        self._turn %= len(frames)
