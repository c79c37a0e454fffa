"""Nodes that load a bus and mean nothing: a babbling idiot, and other nodes' background traffic.

A talker has a port of its own on the wire: it arbitrates, waits and is acknowledged as any node. It is event driven:
``next_ns`` tells when ``advance`` has something to do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from bus.config import Babble, Background, BusConfig
from bus.frames import Frame
from bus.impairment import NEVER
from bus.timing import frame_ns

if TYPE_CHECKING:
    from bus.wire import Wire

_SECOND = 1_000_000_000
_STANDING = 2  # frames that a babbler has in its queue at most: one on the wire and the next


class Talker:
    """Base: sends while its switch, a rate or a share, is above zero. ``fd``: CAN FD frames with bit-rate switch;
    otherwise classical ones, of at most 8 bytes."""

    switch: str  # the key that turns it on

    def __init__(self, wire: Wire, port: int, config: Babble | Background, fd: bool = True) -> None:
        self._wire, self._port, self._fd = wire, port, fd
        self._values: dict[str, Any] = dict(config)
        self.next_ns = 0 if self._values[self.switch] else NEVER
        self.sent = 0  # frames offered to the wire

    def set(self, key: str, value: Any, now_ns: int) -> None:
        """Change one value, a key of its configuration, in SI units. Raises KeyError for another key."""
        if key not in self._values:
            raise KeyError(f"no {key!r}; there is {', '.join(self._values)}")
        self._values[key] = value
        if key == self.switch:
            self.next_ns = now_ns if value else NEVER

    def advance(self, now_ns: int) -> None:
        """Send what is due by ``now_ns``."""
        while self.next_ns <= now_ns:
            self.next_ns += max(self._send(self.next_ns), 1)

    def _send(self, now_ns: int) -> int:
        """Offer one frame; returns the time until the next one, ns."""
        raise NotImplementedError

    def _offer(self, now_ns: int, identifier: int, content: bytes) -> Frame:
        frame = Frame(identifier, content if self._fd else content[:8], self._fd, self._fd)
        self._wire.offer(now_ns, self._port, frame)
        self.sent += 1
        return frame

    def snapshot(self) -> dict[str, Any]:
        return {"values": dict(self._values), "next_ns": self.next_ns, "sent": self.sent}

    def restore(self, state: dict[str, Any]) -> None:
        self._values = dict(state["values"])
        self.next_ns, self.sent = state["next_ns"], state["sent"]


class Babbler(Talker):
    """Sends one identifier at a rate; beyond what the bus carries back to back, as its queue never empties."""

    switch = "rate"

    def _send(self, now_ns: int) -> int:
        values = self._values
        if self._wire.waiting(self._port) < _STANDING:
            self._offer(now_ns, values["identifier"], bytes(values["length"]))
        return round(_SECOND / values["rate"])


class BackgroundTraffic(Talker):
    """Frames that take a given share of the bus's time: after a frame of duration d the next follows after d/load,
    in the mean when they come at random. What the wire refuses because the queue is full is lost."""

    switch = "load"

    def __init__(
        self, wire: Wire, port: int, config: BusConfig, streams: Callable[[str], Any], fd: bool = True
    ) -> None:
        super().__init__(wire, port, config.background, fd)
        self._rates = config.arbitration_rate, config.data_rate
        name = f"bus.{wire.name}.background"
        self._streams = {kind: streams(f"{name}.{kind}") for kind in ("content", "gap", "identifier")}

    def _send(self, now_ns: int) -> int:
        values, streams = self._values, self._streams
        poisson = values["pattern"] == "poisson"
        if poisson:
            index = int(streams["identifier"].uniform() * values["identifiers"])
        else:
            index = self.sent % values["identifiers"]
        draw = streams["content"].uniform
        content = b"".join(int(draw() * 2**32).to_bytes(4, "little") for _ in range(-(-values["length"] // 4)))
        frame = self._offer(now_ns, min(values["identifier"] + index, 0x7FF), content[: values["length"]])
        gap = frame_ns(frame, *self._rates) / values["load"]
        return round(-math.log1p(-streams["gap"].uniform()) * gap if poisson else gap)

    def snapshot(self) -> dict[str, Any]:
        return super().snapshot() | {"streams": {k: s.snapshot() for k, s in self._streams.items()}}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        for kind, saved in state["streams"].items():
            self._streams[kind].restore(saved)
