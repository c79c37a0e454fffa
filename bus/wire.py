"""The wire of one CAN bus: arbitration, frame times from the bits, and who hears of what.

Two ways lead from the start of a frame to its end. As long as all nodes are in order, one of them alone has the lowest
identifier and no bit is damaged, the outcome is known from the frame's length: the short way, here. Everything
else, collisions, damaged bits, error frames, bus off, goes by ``bus.medium``, bit by bit where it has to. Both give
the same times; a test holds them against each other.

Receivers get a frame at the end of its EOF field. A port stands for a node that takes part, and acknowledges, from the
beginning, whether or not it ever sends.
"""

from __future__ import annotations

import heapq

from bus.frames import Frame
from bus.link import NEVER
from bus.medium import QUEUE, Delivery, Entry, PortState
from bus.timing import INTERMISSION, TAIL, contender
from bus.traffic import Traffic, Wait
from bus.wire_faults import FaultyMedium

__all__ = ["QUEUE", "Delivery", "PortState", "Traffic", "Wait", "Wire"]


class Wire(FaultyMedium):
    """One bus with ``ports`` ports. Event driven: ``next_ns`` tells when ``advance`` has something to do.

    A frame that is offered while the bus is idle takes part in the arbitration of that instant, together with
    all others offered at the same time: the calendar offers first and advances then. The end of a frame is
    the end of its EOF field; the next one starts after the intermission.
    """

    def offer(self, now_ns: int, port: int, frame: Frame) -> bool:
        """Put ``frame`` into the transmit queue of ``port``. False when that is full: the frame is refused.

        Raises InvalidFrameError for a frame that no controller could send.
        """
        priority, slow, fast = contender(frame)
        queued = self._queued[port]
        if queued >= QUEUE:
            self.refused += 1
            return False
        self._queued[port] = queued + 1
        self._order += 1
        entry = (priority, port, self._order, now_ns, frame, slow, fast)
        if self._fifo and queued:
            self._behind[port].append(entry)
            return True
        heapq.heappush(self._waiting, entry)
        if self._sending is None:
            start = now_ns if now_ns > self._free_at else self._free_at
            if start < self.next_ns:
                self.next_ns = start
        return True

    def advance(self, now_ns: int) -> list[Delivery]:
        """Process what happens at ``now_ns``: a frame's end, delayed deliveries, the next frame's start."""
        delivered: list[Delivery] = []
        sending = self._sending
        if sending is not None and sending[0] <= now_ns:
            self._sending = None
            entry = sending[2]
            if entry is None:
                self._conclude(now_ns, sending, delivered)
            else:
                self._note_sent(entry, sending[1])
                self._deliver(Delivery(now_ns, entry[1], entry[4]), delivered)
        if self._line.next_ns <= now_ns:
            delivered += self._arrived(now_ns)
        while self._foretold and self._foretold[0][0] <= now_ns:
            self.told.append(self._foretold.pop(0))
        if self._free_at <= now_ns and self._sending is None:
            if not self._nodes.calm:
                self._wake(now_ns)
            if self._waiting and self._sending is None:
                self._start(now_ns)
        self._schedule()
        return delivered

    def _start(self, now_ns: int) -> None:
        draw, damaged = True, None
        if self._nodes.calm and not self._armed:
            waiting = self._waiting
            entry = heapq.heappop(waiting)
            if not waiting or waiting[0][0] != entry[0] or not self._contended(entry):
                slow, fast = entry[5] + TAIL - INTERMISSION, entry[6]
                draw, damaged = False, None if self._impairment.clean else self._impairment.damaged_at(slow + fast)
                if damaged is None:
                    ends = now_ns + self._rates.ns(slow, fast)
                    self._free_at = free_at = ends + self._intermission_ns
                    self.busy_ns += free_at - now_ns
                    self._sending = (ends, now_ns, entry, None)
                    return
            heapq.heappush(waiting, entry)
        self._attempt(now_ns, draw, damaged)

    def _contended(self, entry: Entry) -> bool:
        """Whether another port wants to send the same identifier."""
        priority, port = entry[0], entry[1]
        for other in self._waiting:  # noqa: SIM110  twice as fast as any()
            if other[0] == priority and other[1] != port:
                return True
        return False

    def _schedule(self) -> None:
        if self._sending is not None:
            upcoming = self._sending[0]
        elif not self._nodes.calm:
            upcoming = self._next_with_faults()
        elif self._waiting:
            upcoming = self._free_at
        else:
            upcoming = NEVER
        if self._line.next_ns < upcoming:
            upcoming = self._line.next_ns
        if self._foretold and self._foretold[0][0] < upcoming:
            upcoming = self._foretold[0][0]
        self.next_ns = upcoming
