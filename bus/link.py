"""The Zenoh link in virtual time: what is sent arrives later, changed, out of order, twice or not at all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bus.config import Impairment
from bus.impairment import NEVER, ImpairmentModel, Line

__all__ = ["NEVER", "Link", "LinkItem"]

LinkItem = tuple[int, int, bytes]  # source or bus, CAN identifier, data


def _changed(item: LinkItem, change: Callable[[bytes], bytes]) -> LinkItem:
    source, can_id, data = item
    changed = change(data)
    return item if changed is data else (source, can_id, changed)


class Link:
    """One direction of the link. A damaged sample is discarded, as its check sum would have it."""

    def __init__(self, name: str, config: Impairment, streams: Callable[[str], Any]) -> None:
        self.name = name
        self._impairment = ImpairmentModel(name, config, streams)
        self.line = Line(self._impairment, _changed)  # what is under way
        self.pop_due = self.line.pop_due
        self.sent = 0
        self.lost = 0

    def send(self, now_ns: int, item: LinkItem, bits: int) -> None:
        """Put ``item``, ``bits`` long, on its way."""
        self.sent += 1
        if self._impairment.clean:
            self.line.put(now_ns, item)
        elif self._impairment.damaged_at(bits) is not None or not self.line.send(now_ns, item):
            self.lost += 1

    def at_once(self) -> bool:
        """Whether what is sent arrives at once, with nothing under way before it. If so it is counted here, and the
        caller may pass it on himself."""
        if self._impairment.clean and self.line.next_ns == NEVER:
            self.sent += 1
            return True
        return False

    @property
    def next_ns(self) -> int:
        """When the next sample arrives, ns; NEVER when none is under way."""
        return self.line.next_ns

    def set(self, key: str, value: Any) -> None:
        """Change one impairment; what is under way already is not affected."""
        self._impairment.set(key, value)

    @property
    def counts(self) -> dict[str, int]:
        """What has happened to the samples so far."""
        line = self.line
        return {
            "sent": self.sent, "lost": self.lost, "duplicated": line.duplicated, "corrupted": line.corrupted,
            "reordered": line.reordered,
        }  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        return {
            "line": self.line.snapshot(),
            "counts": (self.sent, self.lost),
            "impairment": self._impairment.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.line.restore(state["line"])
        self.sent, self.lost = state["counts"]
        self._impairment.restore(state["impairment"])
