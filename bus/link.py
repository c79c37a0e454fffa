"""The Zenoh link in virtual time: what is sent arrives later, out of order, or not at all, as configured."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any

from bus.config import Impairment
from bus.impairment import ImpairmentModel

NEVER = 1 << 62  # time of an event that is not foreseen, ns


class Link:
    """One direction of the link. A damaged sample is discarded, as its check sum would have it."""

    def __init__(self, name: str, config: Impairment, streams: Callable[[str], Any]) -> None:
        self.name = name
        self._impairment = ImpairmentModel(name, config, streams)
        self._heap: list[tuple[int, int, Any]] = []
        self._sequence = 0
        self.sent = 0
        self.lost = 0

    def send(self, now_ns: int, item: Any, bits: int) -> None:
        """Put ``item``, ``bits`` long, on its way."""
        self.sent += 1
        arrival = now_ns
        impairment = self._impairment
        if not impairment.clean:
            if impairment.lost() or impairment.damaged_at(bits) is not None:
                self.lost += 1
                return
            arrival += impairment.extra_ns()
        self._sequence += 1
        heapq.heappush(self._heap, (arrival, self._sequence, item))

    def next_time(self) -> int:
        """When the next item arrives, ns; NEVER when none is under way."""
        return self._heap[0][0] if self._heap else NEVER

    def pop_due(self, now_ns: int) -> list[tuple[int, Any]]:
        """(arrival, item) of all that have arrived by ``now_ns``, in order of arrival."""
        due = []
        heap = self._heap
        while heap and heap[0][0] <= now_ns:
            arrival, _, item = heapq.heappop(heap)
            due.append((arrival, item))
        return due

    def set(self, key: str, value: float) -> None:
        """Change one impairment; what is under way already is not affected."""
        self._impairment.set(key, value)

    def snapshot(self) -> dict[str, Any]:
        return {
            "heap": list(self._heap),
            "counts": (self._sequence, self.sent, self.lost),
            "impairment": self._impairment.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._heap = list(state["heap"])
        self._sequence, self.sent, self.lost = state["counts"]
        self._impairment.restore(state["impairment"])
