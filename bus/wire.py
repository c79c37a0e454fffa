"""The wire of one CAN bus: arbitration by identifier, frame times from the bits, errors and retransmission.

Simplifications: all receivers acknowledge; there are no error counters, so no node goes error passive or bus
off; two ports that send the same identifier at once do not collide, the lower port goes first
(``collisions`` counts it). Receivers get a frame at the end of its EOF field. A bit error is seen by all
nodes.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any, NamedTuple

from bus.config import BusConfig
from bus.frames import Frame
from bus.impairment import ImpairmentModel
from bus.link import NEVER
from bus.timing import INTERMISSION, TAIL, BitRates, FrameBits, frame_bits

QUEUE = 32  # frames that wait in one port's controller, as many as an M_CAN has transmit buffers

# After a bit error: an active error flag, its echo by the other nodes at worst, delimiter, intermission.
_ERROR_FRAME_BITS = 6 + 6 + 8 + INTERMISSION


_Entry = tuple[int, int, int, int, Frame, FrameBits]  # priority, port, order, offered at, frame, its bits


class Wait(NamedTuple):
    """How long the frames of one identifier waited for the bus, ns."""

    frames: int
    shortest: int
    mean: float
    longest: int


class Delivery(NamedTuple):
    """A frame that reaches every port but its sender's at ``time`` ns."""

    time: int
    sender: int
    frame: Frame


def _priority(frame: Frame) -> int:
    """Order of arbitration: the identifier's bits as they are sent; a base frame beats an extended one."""
    if frame.extended:
        return (frame.id >> 18) << 20 | 1 << 19 | 1 << 18 | (frame.id & 0x3FFFF)
    return frame.id << 20


class Wire:
    """One bus with ``ports`` ports. Event driven: ``next_time`` tells when ``advance`` has something to do.

    A frame that is offered while the bus is idle takes part in the arbitration of that instant, together with
    all others offered at the same time: the calendar offers first and advances then. The end of a frame is
    the end of its EOF field; the next one starts after the intermission.
    """

    def __init__(self, name: str, config: BusConfig, ports: int, streams: Callable[[str], Any]) -> None:
        self.name = name
        self.ports = ports
        self._rates = BitRates(config.arbitration_rate, config.data_rate)
        self._intermission_ns = self._rates.ns(INTERMISSION)
        self._error_frame_ns = self._rates.ns(_ERROR_FRAME_BITS)
        self._impairment = ImpairmentModel(f"bus.{name}", config, streams)
        self._waiting: list[_Entry] = []  # a heap: its first entry wins the next arbitration
        self._queued = [0] * ports
        self._order = 0
        self._free_at = 0  # the bus is idle from here on
        self._sending: tuple[int, bool, _Entry] | None = None  # ends at, intact
        self._delayed: list[tuple[int, int, Delivery]] = []  # by time, sequence
        self.busy_ns = 0
        self.sent = 0
        self.lost = 0
        self.errors = 0
        self.refused = 0  # offered to a full transmit queue
        self.collisions = 0
        self.longest_wait_ns = 0
        self._waits: dict[tuple[int, bool], list[int]] = {}  # frames, shortest, sum, longest
        self._next = NEVER

    def offer(self, now_ns: int, port: int, frame: Frame) -> bool:
        """Put ``frame`` into the transmit queue of ``port``. False when that is full: the frame is refused.

        Raises InvalidFrameError for a frame that no controller could send.
        """
        bits = frame_bits(frame)
        if self._queued[port] >= QUEUE:
            self.refused += 1
            return False
        self._queued[port] += 1
        self._order += 1
        heapq.heappush(self._waiting, (_priority(frame), port, self._order, now_ns, frame, bits))
        if self._sending is None:
            start = now_ns if now_ns > self._free_at else self._free_at
            if start < self._next:
                self._next = start
        return True

    def waiting(self, port: int) -> int:
        """How many frames of ``port`` wait in its transmit queue."""
        return self._queued[port]

    def next_time(self) -> int:
        """Time of the next event, ns; NEVER when the bus is idle and nothing is under way."""
        return self._next

    def advance(self, now_ns: int) -> list[Delivery]:
        """Process what happens at ``now_ns``: a frame's end, delayed deliveries, the next frame's start."""
        delivered: list[Delivery] = []
        sending = self._sending
        if sending is not None and sending[0] <= now_ns:
            self._finish(now_ns, sending, delivered)
        while self._delayed and self._delayed[0][0] <= now_ns:
            delivered.append(heapq.heappop(self._delayed)[2])
        if self._sending is None and self._waiting and self._free_at <= now_ns:
            self._start(now_ns)
        self._schedule()
        return delivered

    def _start(self, now_ns: int) -> None:
        entry = heapq.heappop(self._waiting)
        priority, port, _, offered, frame, bits = entry
        if self._waiting and self._waiting[0][0] == priority and self._waiting[0][1] != port:
            self.collisions += 1
        slow, fast = bits
        slow += TAIL - INTERMISSION
        damaged = None if self._impairment.clean else self._impairment.damaged_at(slow + fast)
        if damaged is None:
            self._note_wait(frame, now_ns - offered)
            duration = self._rates.ns(slow, fast)
            gap = self._intermission_ns
        else:
            duration = self._rates.ns_until(damaged, bits)
            gap = self._error_frame_ns
        self._sending = (now_ns + duration, damaged is None, entry)
        self._free_at = now_ns + duration + gap
        self.busy_ns += duration + gap

    def _note_wait(self, frame: Frame, wait: int) -> None:
        if wait > self.longest_wait_ns:
            self.longest_wait_ns = wait
        key = (frame.id, frame.extended)
        entry = self._waits.get(key)
        if entry is None:
            self._waits[key] = [1, wait, wait, wait]
            return
        entry[0] += 1
        entry[2] += wait
        if wait > entry[3]:
            entry[3] = wait
        elif wait < entry[1]:
            entry[1] = wait

    def waits(self) -> dict[tuple[int, bool], Wait]:
        """By (identifier, extended): how long frames waited until the attempt that succeeded."""
        entries = sorted(self._waits.items())
        return {key: Wait(n, low, total / n, high) for key, (n, low, total, high) in entries}

    def _finish(self, now_ns: int, sending: tuple[int, bool, _Entry], delivered: list[Delivery]) -> None:
        _, intact, entry = sending
        self._sending = None
        if not intact:  # the controller sends it again, ahead of later frames of the same identifier
            self.errors += 1
            heapq.heappush(self._waiting, entry)
            return
        port, frame = entry[1], entry[4]
        self.sent += 1
        self._queued[port] -= 1
        impairment = self._impairment
        if impairment.clean:
            delivered.append(Delivery(now_ns, port, frame))
        elif impairment.lost():
            self.lost += 1
        else:
            arrival = now_ns + impairment.extra_ns()
            if arrival == now_ns:
                delivered.append(Delivery(now_ns, port, frame))
            else:
                self._order += 1
                heapq.heappush(self._delayed, (arrival, self._order, Delivery(arrival, port, frame)))

    def _schedule(self) -> None:
        if self._sending is not None:
            upcoming = self._sending[0]
        elif self._waiting:
            upcoming = self._free_at
        else:
            upcoming = NEVER
        if self._delayed and self._delayed[0][0] < upcoming:
            upcoming = self._delayed[0][0]
        self._next = upcoming

    def set(self, key: str, value: float) -> None:
        """Change one impairment from the next frame on."""
        self._impairment.set(key, value)

    _PLAIN = (
        "_order", "_free_at", "_sending", "busy_ns", "sent", "lost", "errors", "refused", "collisions",
        "longest_wait_ns", "_next",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            "waiting": list(self._waiting),
            "queued": list(self._queued),
            "waits": {key: list(entry) for key, entry in self._waits.items()},
            "delayed": list(self._delayed),
            "impairment": self._impairment.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self._waiting = list(state["waiting"])
        self._queued = list(state["queued"])
        self._waits = {key: list(entry) for key, entry in state["waits"].items()}
        self._delayed = list(state["delayed"])
        self._impairment.restore(state["impairment"])
