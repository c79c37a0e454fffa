"""Faults of a wire and its nodes, set from outside; what they are is written in ``bus.nodes``."""

from __future__ import annotations

import heapq
import math
from collections import deque

from bus.bitstream import Field
from bus.link import NEVER
from bus.medium import Medium


class FaultyMedium(Medium):
    """Faults by port. ``now_ns`` is the time of the run; all but a stuck wire take effect with the next frame. A port
    that does not exist is a ValueError."""

    def damage(
        self, identifier: int, occurrence: int, bit: int | str, extended: bool = False, port: int | None = None
    ) -> None:
        """Have one bit seen wrong in the ``occurrence``-th (from 1) attempt to send ``identifier`` from now on.

        bit: from SOF with its stuff bits (0), or a field and the bit in it without stuff bits ("data:12", "crc:0",
        "ack", "eof:5"; names of ``bus.bitstream.Field``). A bit that the frame does not have is not damaged. port:
        the only one that sees it; by default all do. Raises ValueError for what cannot be a bit or an occurrence.
        """
        if isinstance(bit, str):
            name, _, number = bit.partition(":")
            if name.upper() not in Field.__members__ or not (number or "0").isdecimal():
                names = ", ".join(field.name.lower() for field in Field)
                raise ValueError(f"no bit {bit!r}: expected a number, or FIELD or FIELD:NUMBER with one of {names}")
        elif bit < 0:
            raise ValueError(f"bit {bit}: expected 0 or more")
        if occurrence < 1:
            raise ValueError(f"occurrence {occurrence}: expected 1 or more")
        if port is not None:
            self._check_port(port)
        self._armed.setdefault((identifier, extended), []).append((occurrence, bit, port))

    def cut(self, port: int, on: bool, now_ns: int) -> None:
        """Cut the cable of a node: it neither sends, receives nor acknowledges."""
        self._set_fault(self._nodes.cut, port, on, now_ns)

    def listen_only(self, port: int, on: bool, now_ns: int) -> None:
        """A node that receives, but sends nothing: no frame, no acknowledgement, no error flag."""
        self._set_fault(self._nodes.listen_only, port, on, now_ns)

    def one_shot(self, port: int, on: bool, now_ns: int) -> None:
        """A node that gives a frame up when it loses arbitration or fails."""
        self._set_fault(self._nodes.one_shot, port, on, now_ns)

    def bit_rate_error(self, port: int, factor: float, now_ns: int) -> None:
        """Let a node run at ``factor`` times the right bit rates; 1 is right. Raises ValueError unless 0.5 … 2."""
        self._check_port(port)
        if not (math.isfinite(factor) and 0.5 <= factor <= 2):
            raise ValueError(f"bit rate factor {factor!r}: expected 0.5 to 2")
        self._nodes.rate.pop(port, None)
        if factor != 1:
            self._nodes.rate[port] = factor
        self._faults_changed(now_ns)

    def restart(self, port: int, now_ns: int) -> None:
        """Ask a node that is bus off to recover: it is back after 128 sequences of 11 recessive bits. Nothing happens
        to any other."""
        self._check_port(port)
        self._nodes.restart(port, self._free_at - self._integration_ns, now_ns)
        self._faults_changed(now_ns)

    def stuck_dominant(self, port: int, on: bool, now_ns: int) -> None:
        """Let a node's transceiver pull the wire dominant, at once: a frame under way is destroyed and its sender goes
        bus off, the others become error passive, nobody can send. When it lets go, or its cable is cut, the bus is
        free 11 bits later."""
        self._set_fault(self._nodes.stuck, port, on, now_ns)

    def unplug(self, port: int, now_ns: int) -> bool:
        """Take a node off the bus, with its faults, its error counters and what it was to send, so that a sound one can
        be plugged in at its port. False while a frame of its is under way: to be called again when that has ended."""
        self.stuck_dominant(port, False, now_ns)
        self._withdraw(port)
        if self._queued[port]:
            self._look_again(now_ns)
            return False
        sending = self._sending
        if sending is not None and sending[3] is not None:
            sending[3][1].forget(port)
        self._foretold = [event for event in self._foretold if event[1] != port]
        self._nodes.renew(port)
        self._faults_changed(now_ns)
        return True

    def _withdraw(self, port: int) -> None:
        """Give up what a node wants to send; what is under way is not sent again."""
        sending = self._sending
        under_way = sending[3][0].get(port) if sending is not None and sending[3] is not None else None
        if under_way is not None:
            self._withdrawn.add(under_way[2])
        behind, self._behind[port] = self._behind[port], deque()
        first = [entry for entry in sorted(self._waiting) if entry[1] == port and entry is not under_way]
        for entry in first:
            self._remove(entry)
        for entry in (*first, *behind):
            self._give_up(entry)

    def _jam(self, now_ns: int) -> None:
        sending = self._sending
        if sending is None or sending[0] <= now_ns:
            return  # as soon as the bus is free
        self.busy_ns -= self._free_at - sending[1]
        self._foretold = []
        entries = sending[3][0] if sending[3] is not None else {}
        if sending[2] is not None:
            entries = {sending[2][1]: sending[2]}
            heapq.heappush(self._waiting, sending[2])
        heads = {port: self._nodes.as_sent(port, entry[4]) for port, entry in entries.items()}
        self._follow(sending[1], entries, self._nodes.jam(sending[1], heads, now_ns))

    def _let_go(self, now_ns: int) -> None:
        sending = self._sending
        if sending is not None and sending[3] is not None and sending[3][1].jammed:
            self._sending = None
            self._conclude(now_ns, sending, [])  # with the counters that it would have come to
            self._foretold = [event for event in self._foretold if event[0] <= now_ns]
        if self._free_at == NEVER:
            self.busy_ns += now_ns - self._jammed_since
            self._free_at = now_ns + self._integration_ns

    def _set_fault(self, ports: set[int], port: int, on: bool, now_ns: int) -> None:
        self._check_port(port)
        dominant = self._nodes.dominant
        (ports.add if on else ports.discard)(port)
        if self._nodes.dominant != dominant:
            (self._let_go if dominant else self._jam)(now_ns)
        self._faults_changed(now_ns)

    def _check_port(self, port: int) -> None:
        if not 0 <= port < self.ports:
            raise ValueError(f"bus {self.name} has no port {port}: expected 0 to {self.ports - 1}")

    def _faults_changed(self, now_ns: int) -> None:
        self._nodes.changed()
        self._look_again(now_ns)

    def _look_again(self, now_ns: int) -> None:
        self._schedule()
        self.next_ns = max(self.next_ns, now_ns)
