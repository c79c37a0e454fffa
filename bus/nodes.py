"""The nodes of a bus: their error counters and faults, and what becomes of an attempt to send.

As long as all is well (``calm``) the wire does not ask. Otherwise each attempt is decided here: from the frame's length
where nothing can go wrong, bit by bit (``bus.controller``) where something does.

Approximations. A fault but ``stuck_dominant`` takes effect with the next frame. A cut node has no bus of its own: its
frames wait, its counters stand still. A node that is late, still in the delimiter of a passive error flag when the
next frame starts, misses that frame without counting an error. Two ports that send the very same frame at once
both succeed; it is delivered once, as from the lower port. A node with a wrong bit rate is resynchronised at every
recessive to dominant edge and reads the bit beside an edge wrong when its phase error has grown beyond the
segment after the sample point (20 % of a bit): edges are at most 10 bits apart, so up to 2 % nothing happens, and
the larger the error the more frames suffer. Its phase is reckoned in bits of either rate.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from bus.bitstream import DOMINANT, RECESSIVE, encode
from bus.confinement import Counters, restarted_frame, state_frame
from bus.controller import Controller, play
from bus.frames import ErrorFrame, Frame
from bus.timing import INTERMISSION, TAIL, BitRates, frame_bits

RECOVERY = 128  # sequences of 11 recessive bits from bus off to error active
_SEQUENCE = 11
_SUSPEND = 8  # bits that an error passive node waits after having sent
_PHASE_MARGIN = 0.2  # of a bit, from the sample point to its end

Event = tuple[int, int, ErrorFrame]  # time in ns, port


@dataclass(slots=True)
class Outcome:
    """What an attempt comes to. Times in ns of the run; ``counters`` and the like hold from ``ends`` on."""

    ends: int  # of the frame, or when it turned out to be broken
    idle: int  # the next frame can start
    frame: Frame | None = None  # as somebody received it
    sender: int = 0
    missed: int = 0  # bit mask of the ports that did not receive it
    sent: tuple[int, ...] = ()  # ports whose frame got through
    failed: tuple[int, ...] = ()  # ports whose frame did not, but for lost arbitration
    error: bool = False
    jammed: bool = False  # the wire stays dominant
    events: list[Event] = field(default_factory=list)
    counters: dict[int, Counters] = field(default_factory=dict)
    ready_at: dict[int, int] = field(default_factory=dict)
    may_send_at: dict[int, int] = field(default_factory=dict)

    def forget(self, port: int) -> None:
        """Let nothing come of it for ``port``, where another node is now."""
        for of_ports in (self.counters, self.ready_at, self.may_send_at):
            of_ports.pop(port, None)
        self.events = [event for event in self.events if event[1] != port]


def misread(levels: bytes | bytearray, ratio: float) -> frozenset[int]:
    """Bits of ``levels`` that a node reads wrong whose bits last ``ratio`` times those of the sender."""
    limit = _PHASE_MARGIN / abs(ratio - 1) if ratio != 1 else len(levels)
    wrong, last = set(), 0
    for n in range(1, len(levels)):
        if levels[n - 1] == RECESSIVE and levels[n] == DOMINANT:
            if n - last > limit:
                wrong.add(n - 1 if ratio > 1 else n)
            last = n
    return frozenset(wrong)


class Nodes:
    """Counters, modes and faults by port."""

    def __init__(self, ports: int, rates: BitRates, automatic_recovery: bool) -> None:
        self._rates, self._automatic = rates, automatic_recovery
        self._bit = rates.ns(1)
        self.counters = [Counters() for _ in range(ports)]
        self._ready_at = [0] * ports
        self._may_send_at = [0] * ports
        self.cut: set[int] = set()
        self.stuck: set[int] = set()
        self.listen_only: set[int] = set()
        self.one_shot: set[int] = set()
        self.rate: dict[int, float] = {}
        self._recovering: dict[int, int] = {}  # sequences that are still to be seen
        self.calm = True
        self.changed()

    def changed(self) -> None:
        """To be called when a fault was set: whether the wire may take the short way."""
        normal = not (self.cut or self.stuck or self.listen_only or self.one_shot or self.rate)
        self.calm = normal and len(self.counters) > 1 and all(one.clear for one in self.counters)

    @property
    def dominant(self) -> bool:
        """Whether a stuck node holds the wire."""
        return bool(self.stuck - self.cut)

    def renew(self, port: int) -> None:
        """Put a sound node in the place of another."""
        for faulty in (self.cut, self.stuck, self.listen_only, self.one_shot):
            faulty.discard(port)
        self.rate.pop(port, None)
        self._recovering.pop(port, None)
        self.counters[port] = Counters()
        self._ready_at[port] = self._may_send_at[port] = 0
        self.changed()

    # --- who takes part -----------------------------------------------------------------------------------------

    def takes_part(self, port: int, now: int) -> bool:
        """Whether a node hears a frame that starts now; a bit late still counts, as in the intermission's last."""
        return not (self.counters[port].bus_off or port in self.cut) and self._ready_at[port] <= now + self._bit

    def can_send_from(self, port: int) -> int | None:
        """From when on a node may start a frame; None: not before something changes."""
        if self.counters[port].bus_off or port in self.cut or port in self.listen_only:
            return None
        return max(self._ready_at[port], self._may_send_at[port])

    def as_sent(self, port: int, frame: Frame) -> Frame:
        """The frame with the error state of its sender."""
        return frame._replace(esi=True) if frame.fd and self.counters[port].passive else frame

    # --- attempts -----------------------------------------------------------------------------------------------

    def attempt(
        self, now: int, heads: dict[int, Frame], winner: int, alone: bool, flips: dict[int, set[int]]
    ) -> Outcome:
        """What comes of it when the ports of ``heads`` start their frames at ``now``.

        winner: a port with the lowest identifier. alone: no other port has it. flips: bits that a port sees wrong.
        """
        frame = heads[winner]
        wrong: dict[int, frozenset[int]] = {port: frozenset(bits) for port, bits in flips.items()}
        if self.rate:
            levels = bytearray(encode(frame).levels)
            levels[encode(frame).ack] = DOMINANT
            for port in range(len(self.counters)):
                ratio = self.rate.get(winner, 1.0) / self.rate.get(port, 1.0)
                if port != winner and (skewed := misread(levels, ratio)):
                    wrong[port] = wrong.get(port, frozenset()) | skewed
        hearing = [port for port in range(len(self.counters)) if self.takes_part(port, now)]
        acknowledged = any(port != winner and port not in self.listen_only for port in hearing)
        if alone and acknowledged and not wrong:
            return self._success(now, winner, frame, hearing)
        return self._played(now, heads, hearing, wrong)

    def jam(self, start: int, heads: dict[int, Frame], now: int) -> Outcome:
        """The wire becomes dominant at ``now``, while the frames of ``heads`` are under way since ``start``."""
        hearing = [port for port in range(len(self.counters)) if self.takes_part(port, start)]
        return self._played(start, heads, hearing, {}, now - start)

    def _success(self, now: int, port: int, frame: Frame, hearing: list[int]) -> Outcome:
        slow, fast = frame_bits(frame)
        ends = now + self._rates.ns(slow + TAIL - INTERMISSION, fast)
        out = Outcome(ends, ends + self._rates.ns(INTERMISSION), frame, port, self._all_but(hearing), (port,))
        for one in hearing:
            counters = replace(self.counters[one])
            state = counters.state
            if one == port:
                counters.sent()
            elif one not in self.listen_only:
                counters.received()
            out.counters[one] = counters
            if counters.state != state:
                out.events.append((ends, one, state_frame(counters)))
        if out.counters[port].passive:
            out.may_send_at[port] = out.idle + self._rates.ns(_SUSPEND)
        return out

    def _played(
        self,
        now: int,
        heads: dict[int, Frame],
        hearing: list[int],
        wrong: dict[int, frozenset[int]],
        dominant_ns: int | None = None,
    ) -> Outcome:
        slow, fast, unit = self._rates.lengths()
        receivers: dict[Any, list[int]] = {}  # those that differ in nothing are played as one
        for port in hearing:
            if port not in heads:
                one = self.counters[port]
                key = (one.tec, one.rec, port in self.listen_only, wrong.get(port, frozenset()))
                receivers.setdefault(key, []).append(port)
        controllers = [
            Controller([port], self.counters[port], frame, wrong.get(port, frozenset()))
            for port, frame in heads.items()
        ]
        for (_, _, listening, flips), ports in receivers.items():
            controllers.append(Controller(ports, self.counters[ports[0]], None, flips, listening))
        end = play(controllers, slow, fast, None if dominant_ns is None else dominant_ns * unit)
        return self._outcome(now, controllers, unit, end, dominant_ns is not None)

    def _outcome(self, now: int, controllers: list[Controller], unit: int, end: int, jammed: bool) -> Outcome:
        def ns(time: int) -> int:
            return now - (-time // unit)

        on_bus = [one for one in controllers if not (one.counters.bus_off or one.idle)]
        idle = ns(end if jammed else min((one.ready_at for one in on_bus), default=end))
        senders = [one for one in controllers if one.sent_at >= 0]
        receivers = [one for one in controllers if one.received is not None]
        broken = [one.failed_at for one in controllers if one.failed_at >= 0]
        failed = tuple(one.ports[0] for one in controllers if one.frame is not None and one.transmitter and not
                       one.sent_at >= 0)  # fmt: skip
        ends = max(one.sent_at for one in senders) if senders else 0
        ends = max([ends, *(one.received_at for one in receivers)]) or min(broken, default=end)
        out = Outcome(ns(ends), idle, failed=failed, error=bool(broken), jammed=jammed)
        out.sent = tuple(one.ports[0] for one in senders)
        if receivers:
            out.frame = receivers[0].received
            out.sender = min(out.sent or failed or (0,))
            out.missed = self._all_but([*out.sent, out.sender, *(port for one in receivers for port in one.ports)])
        for one in controllers:
            for port in one.ports:
                out.counters[port] = replace(one.counters)
                out.ready_at[port] = idle if one.idle else ns(one.ready_at)
                out.events += [(ns(time), port, event) for time, event in one.events]
            if one.frame is not None and one.transmitter and one.counters.passive:
                out.may_send_at[one.ports[0]] = ns(one.ready_at) + self._rates.ns(_SUSPEND)
        return out

    def _all_but(self, ports: list[int]) -> int:
        mask = (1 << len(self.counters)) - 1
        for port in ports:
            mask &= ~(1 << port)
        return mask

    def apply(self, out: Outcome) -> None:
        """Take over the state after an attempt."""
        for port, counters in out.counters.items():
            self.counters[port] = counters
            if counters.bus_off and self._automatic:
                self._recovering[port] = RECOVERY
        for port, time in out.ready_at.items():
            self._ready_at[port] = time
        for port, time in out.may_send_at.items():
            self._may_send_at[port] = time
        self.changed()

    # --- recovery from bus off ----------------------------------------------------------------------------------

    def restart(self, port: int, since: int, now: int) -> None:
        """Let a node that is bus off begin to recover; the wire has been recessive since ``since``."""
        if self.counters[port].bus_off and port not in self._recovering:
            self._recovering[port] = RECOVERY + self._sequences(since, now)

    def _sequences(self, since: int, now: int) -> int:
        return max(0, now - since) // self._rates.ns(_SEQUENCE)

    def recovery_at(self, since: int) -> int | None:
        """When the next node is back if the wire stays recessive, as it has been since ``since``."""
        waiting = [left for port, left in self._recovering.items() if port not in self.cut]
        return since + min(waiting) * self._rates.ns(_SEQUENCE) if waiting else None

    def recover(self, since: int, now: int) -> list[Event]:
        """Bring back who has waited long enough at ``now``."""
        events = []
        seen = self._sequences(since, now)
        for port in sorted(self._recovering):
            if seen >= self._recovering[port] and port not in self.cut:
                del self._recovering[port]
                self.counters[port] = Counters()
                events.append((now, port, restarted_frame()))
        if events:
            self.changed()
        return events

    def interrupted(self, since: int, now: int) -> None:
        """A frame starts: the recessive time since ``since`` has been counted."""
        seen = self._sequences(since, now)
        for port in self._recovering:
            if port not in self.cut:
                self._recovering[port] -= seen

    # --- state --------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        return {
            "counters": [(one.tec, one.rec, one.bus_off) for one in self.counters],
            "times": (list(self._ready_at), list(self._may_send_at)),
            "faults": [set(s) for s in (self.cut, self.stuck, self.listen_only, self.one_shot)],
            "rate": dict(self.rate),
            "recovering": dict(self._recovering),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.counters = [Counters(*saved) for saved in state["counters"]]
        self._ready_at, self._may_send_at = (list(times) for times in state["times"])
        self.cut, self.stuck, self.listen_only, self.one_shot = (set(saved) for saved in state["faults"])
        self.rate, self._recovering = dict(state["rate"]), dict(state["recovering"])
        self.changed()
