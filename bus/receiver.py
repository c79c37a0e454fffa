"""A CAN frame from its bits, as a controller reads it: stuff, form and CRC errors at the bit where they show.

Not modelled: the CAN XL bit (a recessive ``res`` is a form error here, where ISO 11898-1 enters protocol
exception), and the second bit time that CAN FD receivers grant to the ACK slot and the CRC delimiter.
"""

from __future__ import annotations

from collections.abc import Generator

from bus.bitstream import DOMINANT, EOF_BITS, RECESSIVE, Field, Kind, ViolationError, frame_check, stuff_count
from bus.frames import CAN_FD_LENGTHS, Frame


class Receiver:
    """Reads one frame bit by bit, as a controller does.

    ``push`` a level: it raises ViolationError at the bit where a controller detects an error. Between two bits,
    ``fast`` tells the rate of the next one and ``acknowledge`` whether to send it dominant. ``frame`` is there from
    the last but one bit of EOF on, which is where a receiver takes a frame for valid; ``done`` after the last, and
    ``overload`` when that one was dominant.
    """

    def __init__(self) -> None:
        self.field = Field.SOF
        self.fast = self.acknowledge = self.acknowledged = self.done = self.overload = False
        self.frame: Frame | None = None
        self._last, self._run = RECESSIVE, 1  # of the bits so far: level, and how many of it at their end
        self._levels: list[int] = []  # with stuff bits
        self._plain: list[int] = []  # without
        self._stuff_bits = 0
        self._steps = self._read()
        next(self._steps)

    def push(self, level: int) -> None:
        self._steps.send(level)

    def _read(self) -> Generator[None, int, None]:
        yield from self._number(Field.SOF, 1)
        identifier = yield from self._number(Field.ID28_21, 8)
        identifier = identifier << 3 | (yield from self._number(Field.ID20_18, 3))
        remote = yield from self._number(Field.SRTR, 1)
        extended = bool((yield from self._number(Field.IDE, 1)))
        if extended:
            for field, width in (Field.ID17_13, 5), (Field.ID12_05, 8), (Field.ID04_00, 5):
                identifier = identifier << width | (yield from self._number(field, width))
            remote = yield from self._number(Field.RTR, 1)
        fd = bool((yield from self._number(Field.RES1, 1)))
        brs = esi = False
        if fd:
            if (yield from self._number(Field.RES0, 1)):
                raise ViolationError(Kind.FORM, Field.RES0)
            self.fast = brs = bool((yield from self._number(Field.RES0, 1)))
            esi = bool((yield from self._number(Field.RES0, 1)))
        elif extended:
            yield from self._number(Field.RES0, 1)
        code = yield from self._number(Field.DLC, 4)
        length = CAN_FD_LENGTHS[code] if fd else min(code, 8)
        remote = bool(remote) and not fd  # CAN FD has no remote frames, receivers take either level of RRS
        data = bytes(length)
        if not remote:
            data = (yield from self._number(Field.DATA, 8 * length)).to_bytes(length)
        intact = yield from (self._check_fd(length) if fd else self._check())
        yield from self._recessive(Field.CRC_DELIMITER)
        self.fast = False
        self.field, self.acknowledge = Field.ACK, intact
        self.acknowledged = (yield) == DOMINANT
        self.acknowledge = False
        yield from self._recessive(Field.ACK_DELIMITER)
        if not intact:
            raise ViolationError(Kind.CRC, Field.CRC)
        for _ in range(EOF_BITS - 1):
            yield from self._recessive(Field.EOF)
        self.frame = Frame(identifier, data, fd, brs, extended, remote, esi)
        self.overload = (yield) == DOMINANT
        self.done = True
        yield

    def _check(self) -> Generator[None, int, bool]:
        expected, width = frame_check(self._plain, False, 0)
        found = yield from self._number(Field.CRC, width)
        yield from self._stuff_bit()
        return found == expected

    def _check_fd(self, length: int) -> Generator[None, int, bool]:
        stuff_bits = self._stuff_bits
        width = 17 if length <= 16 else 21
        found, last = [], self._levels[-1]
        self.field = Field.CRC
        for n in range(4 + width):
            if n % 4 == 0 and (yield) == last:  # a fixed stuff bit
                raise ViolationError(Kind.FORM, Field.CRC)
            last = yield
            found.append(last)
        count = stuff_count(stuff_bits)
        expected = frame_check([*self._levels, *found[:4]], True, length)[0]
        return found == [count >> shift & 1 for shift in (3, 2, 1, 0)] + [
            expected >> shift & 1 for shift in range(width - 1, -1, -1)
        ]

    def _number(self, field: Field, width: int) -> Generator[None, int, int]:
        """The next ``width`` bits, less the stuff bits before them."""
        value = 0
        for _ in range(width):
            yield from self._stuff_bit()
            self.field = field
            level = yield
            self._run = self._run + 1 if level == self._last else 1
            self._last = level
            self._levels.append(level)
            self._plain.append(level)
            value = value << 1 | level
        return value

    def _stuff_bit(self) -> Generator[None, int, None]:
        if self._run == 5:
            level = yield
            if level == self._last:
                raise ViolationError(Kind.STUFF, self.field)
            self._last, self._run = level, 1
            self._levels.append(level)
            self._stuff_bits += 1

    def _recessive(self, field: Field) -> Generator[None, int, None]:
        self.field = field
        if (yield) == DOMINANT:
            raise ViolationError(Kind.FORM, field)


def decode(levels: bytes | list[int]) -> Frame:
    """The frame that ``levels`` carry, from SOF on. Raises ViolationError for what a receiver would not accept."""
    receiver = Receiver()
    for level in levels:
        receiver.push(level)
        if receiver.frame is not None:
            return receiver.frame
    raise ViolationError(Kind.FORM, receiver.field)
