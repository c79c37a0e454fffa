"""CAN controllers on one wire, bit by bit: what happens when not all goes well (ISO 11898-1:2015).

``play`` runs what the wire's fast path cannot tell from frame lengths: collisions, bits that some node sees wrong, a
missing acknowledgement, a dominant wire. Nothing here knows the outcome in advance: each controller sends a level,
samples the wire (dominant wins) and follows its own rules, so arbitration, error and overload flags, their overlay and
the error counters come out of that.

Approximations: a node samples the level at the end of its bit, all bits start at the same time (no propagation
delay); it is synchronised at the SOF and not again, so after flags at different rates nodes may be out of step by a
fraction of a bit, until the next SOF. The rate is switched at the borders of bits, see ``bus.timing``. ISO 11898-1
leaves it open whether a controller that becomes bus off finishes its error flag; here it does.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace

from bus.bitstream import DOMINANT, RECESSIVE, Field, Kind, ViolationError, encode
from bus.confinement import PASSIVE, Counters, State, state_frame, violation_frame
from bus.frames import ErrorFrame, Frame
from bus.receiver import Receiver

_FLAG, _DELIMITER, _INTERMISSION = 6, 8, 3
_TOLERATED = 8  # dominant bits after a flag, until rule f counts them

_Steps = Generator[int, int, "ViolationError | _Overload | None"]


class _Overload:
    """The wish for an overload frame."""


_OVERLOAD = _Overload()


class Controller:
    """One controller from the start of a frame until it is ready for the next one.

    ports: who it stands for; controllers that see the same and count the same behave the same.
    frame: what it sends, None for a receiver. flips: bits that it sees wrong, counted from SOF.
    """

    def __init__(
        self,
        ports: list[int],
        counters: Counters,
        frame: Frame | None = None,
        flips: frozenset[int] = frozenset(),
        listen_only: bool = False,
    ) -> None:
        self.ports, self.frame, self.flips, self.listen_only = ports, frame, flips, listen_only
        self.counters = replace(counters)
        self.events: list[tuple[int, ErrorFrame]] = []
        self.transmitter = frame is not None  # still, or when the error was detected
        self.sent_at = self.received_at = self.failed_at = self.ready_at = -1
        self.received: Frame | None = None
        self.idle = frame is None  # waits for a SOF
        self.saturated = False  # nothing changes any more while the wire stays dominant
        self.fast = False  # rate of the bit that is being sent
        self.until = 0  # when that bit ends
        self._in_frame = True
        self._bit = 0
        self._now = 0
        self._steps = self._run()
        self.drive = next(self._steps)

    def step(self, now: int, level: int) -> None:
        """Sample ``level`` at the end of a bit and decide on the next one."""
        self._now = now
        if self._in_frame and self._bit in self.flips:
            level ^= 1
        self._bit += 1
        try:
            self.drive = self._steps.send(level)
        except StopIteration:
            self.drive, self.ready_at = RECESSIVE, now

    def _run(self) -> Generator[int, int, None]:
        pending: ViolationError | _Overload | None
        try:
            pending = yield from self._receive(Receiver()) if self.frame is None else self._transmit(self.frame)
        except ViolationError as violation:
            pending = violation
            self.failed_at = self._now
        self._in_frame = self.fast = False
        while True:
            if pending is None:
                pending = yield from self._intermission()
                if pending is None:
                    return
            pending = yield from self._flag(pending)
            if self.counters.bus_off:
                return

    def _transmit(self, frame: Frame) -> _Steps:
        bits = encode(frame)
        receiver = Receiver()  # in case of lost arbitration
        for n, level in enumerate(bits.levels[: bits.eof]):
            self.fast = n in bits.fast
            seen = yield level
            field = Field(bits.fields[n])
            if n == bits.ack:
                if seen:
                    raise ViolationError(Kind.ACK, field)
            elif seen == level:
                if n < bits.arbitration:
                    receiver.push(seen)
            elif n < bits.arbitration and level == RECESSIVE:
                if bits.stuffed[n]:
                    raise ViolationError(Kind.STUFF, field)
                self.transmitter = False
                receiver.push(seen)
                return (yield from self._receive(receiver))
            else:
                raise ViolationError(Kind.BIT0 if level == DOMINANT else Kind.BIT1, field)
        self._count(self.counters.sent)
        self.sent_at = self._now
        return None

    def _receive(self, receiver: Receiver) -> _Steps:
        while self.idle:
            if (yield RECESSIVE) == DOMINANT:
                self.idle = False
                receiver.push(DOMINANT)
        while not receiver.done:
            self.fast = receiver.fast
            acknowledge = receiver.acknowledge and not self.listen_only
            seen = yield DOMINANT if acknowledge else RECESSIVE
            if acknowledge:
                if seen:
                    raise ViolationError(Kind.BIT0, Field.ACK)
                self._count(self.counters.received)
            receiver.push(seen)
        self.received, self.received_at = receiver.frame, self._now
        return _OVERLOAD if receiver.overload else None

    def _intermission(self) -> _Steps:
        for n in range(_INTERMISSION):
            if (yield RECESSIVE) == DOMINANT and n < _INTERMISSION - 1:
                return _OVERLOAD
        return None

    def _flag(self, cause: ViolationError | _Overload) -> _Steps:
        """Error or overload flag, what others add to it, and the delimiter."""
        passive = self.listen_only or (self.counters.passive and isinstance(cause, ViolationError))
        unacknowledged = passive and isinstance(cause, ViolationError) and cause.kind is Kind.ACK
        if isinstance(cause, ViolationError):
            self._report(cause, passive)
        if passive:
            if (yield from self._passive_flag()) and unacknowledged and self.transmitter:
                self._count(self.counters.transmit_error)
        else:
            for _ in range(_FLAG):
                yield DOMINANT
        if self.counters.bus_off:
            return None
        dominant = 0
        while (yield RECESSIVE) == DOMINANT:
            dominant += 1
            if dominant == 1 and isinstance(cause, ViolationError) and not self.transmitter:
                self._count(self.counters.receive_error, 8)
            if dominant % _TOLERATED == 0:
                if self.transmitter:
                    self._count(self.counters.transmit_error)
                else:
                    self._count(self.counters.receive_error, 8)
                if self.counters.bus_off:
                    return None
                self.saturated = self.listen_only or (not self.transmitter and self.counters.rec >= PASSIVE)
        self.saturated = False
        for n in range(1, _DELIMITER):
            if (yield RECESSIVE) == DOMINANT:
                return _OVERLOAD if n == _DELIMITER - 1 else ViolationError(Kind.FORM, Field.ERROR_DELIMITER)
        return None

    def _passive_flag(self) -> Generator[int, int, bool]:
        """Recessive until six bits in a row are equal. Whether one of all was dominant."""
        last, run, dominant = -1, 0, False
        while run < _FLAG:
            seen = yield RECESSIVE
            run = run + 1 if seen == last else 1
            last = seen
            dominant |= seen == DOMINANT
        return dominant

    def _report(self, violation: ViolationError, passive: bool) -> None:
        if self.listen_only:
            return
        before = self.counters.state
        if not self.transmitter:
            self.counters.receive_error()
        elif violation.kind is not Kind.STUFF and not (violation.kind is Kind.ACK and passive):
            self.counters.transmit_error()
        self.events.append((self._now, violation_frame(violation, self.transmitter, self.counters)))
        self._tell_state(before)

    def _count(self, rule: Callable[..., None], *by: int) -> None:
        if self.listen_only:
            return
        before = self.counters.state
        rule(*by)
        self._tell_state(before)

    def _tell_state(self, before: State) -> None:
        if self.counters.state != before:
            self.events.append((self._now, state_frame(self.counters)))


def play(controllers: list[Controller], slow: int, fast: int, dominant_from: int | None = None) -> int:
    """Run ``controllers`` from a common SOF at time 0 until all are ready, and return the time.

    slow, fast: length of a bit at the arbitration and the data rate, in any unit of time. The wire is dominant from
    ``dominant_from`` on; then it ends when no counter changes any more.
    """
    for one in controllers:
        one.until = fast if one.fast else slow
    running, now = controllers, 0
    while running:
        upcoming, level, settled = running[0].until, RECESSIVE, True
        for one in running:
            upcoming = min(upcoming, one.until)
            level &= one.drive
            settled = settled and (one.idle if dominant_from is None else one.saturated)
        if settled:
            break
        now = upcoming
        if dominant_from is not None and now > dominant_from:
            level = DOMINANT
        for one in running:
            if one.until == now:
                one.step(now, level)
                one.until = now + (fast if one.fast else slow)
        running = [one for one in running if one.ready_at < 0]
    for one in running:
        one.ready_at = now
    return now
