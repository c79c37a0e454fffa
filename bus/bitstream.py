"""The bits of a CAN frame as they run over the wire, and the way back (ISO 11898-1:2015, 10.4 and 10.5).

This is the reference: written for reading, bit by bit. What needs to be fast, the number of a frame's bits, is
counted by ``bus.timing`` and ``bus.stuffing`` without building them, and is tested to be equal.

A level is 0 (dominant) or 1 (recessive). The fields carry the numbers of SocketCAN's ``CAN_ERR_PROT_LOC_*``,
which are those of the SJA1000's error code capture and know no CAN FD: FDF, res, BRS and ESI count as reserved bits.

Not modelled: the CAN XL bit (a recessive ``res`` is a form error here, where ISO 11898-1 enters protocol
exception), and the second bit time that CAN FD receivers grant to the ACK slot and the CRC delimiter.
"""

from __future__ import annotations

from collections.abc import Generator
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

from bus.frames import CAN_FD_LENGTHS, Frame, checked

DOMINANT, RECESSIVE = 0, 1
_EOF_BITS, _INTERMISSION_BITS = 7, 3


class Field(IntEnum):
    """Where in a frame a bit is, as ``CAN_ERR_PROT_LOC_*``."""

    SOF = 0x03
    ID28_21 = 0x02
    ID20_18 = 0x06
    SRTR = 0x04
    IDE = 0x05
    ID17_13 = 0x07
    ID12_05 = 0x0F
    ID04_00 = 0x0E
    RTR = 0x0C
    RES1 = 0x0D
    RES0 = 0x09
    DLC = 0x0B
    DATA = 0x0A
    CRC = 0x08
    CRC_DELIMITER = 0x18
    ACK = 0x19
    ACK_DELIMITER = 0x1B
    EOF = 0x1A
    INTERMISSION = 0x12
    ERROR_DELIMITER = 0x17  # of the SJA1000; SocketCAN has no name for it


class Kind(IntEnum):
    """What is wrong with a bit; the first four as ``CAN_ERR_PROT_*``."""

    FORM = 0x02
    STUFF = 0x04
    BIT0 = 0x08  # sent dominant, saw recessive
    BIT1 = 0x10  # sent recessive, saw dominant
    CRC = 0x100
    ACK = 0x200


class ViolationError(Exception):
    """A bit that no valid frame has here: the ``kind`` of error a controller reports, and the field it is in."""

    def __init__(self, kind: Kind, field: Field) -> None:
        super().__init__(f"{kind.name.lower()} error in {field.name}")
        self.kind, self.field = kind, field


def crc(bits: bytes | list[int], polynomial: int, width: int, start: int) -> int:
    """Remainder of ``bits`` (levels), most significant first, from register content ``start``."""
    register, top, mask = start, width - 1, (1 << width) - 1
    for bit in bits:
        feedback = bit ^ register >> top
        register = register << 1 & mask
        if feedback:
            register ^= polynomial
    return register


def frame_check(bits: bytes | list[int], fd: bool, length: int) -> tuple[int, int]:
    """CRC over ``bits`` and its width: 15 of a classical frame, of a CAN FD frame 17 up to 16 bytes of data,
    21 above. The CAN FD registers start with their top bit set, so that leading dominant bits count."""
    if not fd:
        return crc(bits, 0x4599, 15, 0), 15
    if length <= 16:
        return crc(bits, 0x1685B, 17, 1 << 16), 17
    return crc(bits, 0x102899, 21, 1 << 20), 21


def stuff_count(stuff_bits: int) -> int:
    """The four bits that open a CAN FD frame's CRC field: Gray code of the dynamic stuff bits modulo 8, even parity."""
    count = stuff_bits & 7
    gray = count ^ count >> 1
    return gray << 1 | gray.bit_count() & 1


class Bits(NamedTuple):
    """A frame on the wire, from its SOF to the end of the intermission; the ACK slot as the sender sends it."""

    levels: bytes
    fields: bytes  # the Field of each bit; a stuff bit belongs to the field it follows
    stuffed: bytes  # 1 for a stuff bit
    arbitration: int  # bits up to the end of RTR (RRS)
    fast: range  # bits at the data rate
    ack: int

    @property
    def eof(self) -> int:
        """Number of bits up to the end of the EOF field."""
        return len(self.levels) - _INTERMISSION_BITS

    def place(self, bit: int | str) -> int | None:
        """Index of a bit by number or by ``field:number``, ``data:0`` for the first one; None if there is none."""
        if isinstance(bit, int):
            return bit if 0 <= bit < self.eof else None
        name, _, number = bit.partition(":")
        there = [n for n, field in enumerate(self.fields) if field == Field[name.upper()] and not self.stuffed[n]]
        return there[int(number or 0)] if int(number or 0) < len(there) else None


class _Writer:
    def __init__(self) -> None:
        self.levels, self.fields, self.stuffed = bytearray(), bytearray(), bytearray()
        self.plain: list[int] = []  # without stuff bits
        self.stuff_bits = 0

    def put(self, field: Field, value: int, width: int) -> None:
        """Bits without stuffing."""
        for shift in range(width - 1, -1, -1):
            self._append(field, value >> shift & 1, 0)

    def put_stuffed(self, field: Field, value: int, width: int) -> None:
        """Bits, each after the stuff bit that the five bits before it may require."""
        for shift in range(width - 1, -1, -1):
            self.stuff()
            level = value >> shift & 1
            self.plain.append(level)
            self._append(field, level, 0)

    def stuff(self) -> None:
        last = self.levels[-5:]
        if len(last) == 5 and sum(last) in (0, 5):
            self.stuff_bits += 1
            self._append(Field(self.fields[-1]), 1 - last[-1], 1)

    def put_fixed(self, value: int, width: int) -> None:
        """Bits of the CRC field of CAN FD: a stuff bit before the first and after every fourth of them."""
        for n in range(width):
            if n % 4 == 0:
                self._append(Field.CRC, 1 - self.levels[-1], 1)
            self._append(Field.CRC, value >> (width - 1 - n) & 1, 0)
        if width % 4 == 0:
            self._append(Field.CRC, 1 - self.levels[-1], 1)

    def _append(self, field: Field, level: int, stuff: int) -> None:
        self.levels.append(level)
        self.fields.append(field)
        self.stuffed.append(stuff)


@lru_cache(maxsize=256)
def encode(frame: Frame) -> Bits:
    """The bits of ``frame``. Raises InvalidFrameError for a frame that no controller could send."""
    identifier, data, fd, brs, extended, remote, esi = checked(frame)
    out = _Writer()
    put = out.put_stuffed
    put(Field.SOF, DOMINANT, 1)
    base = identifier >> 18 if extended else identifier
    put(Field.ID28_21, base >> 3, 8)
    put(Field.ID20_18, base & 7, 3)
    if extended:
        put(Field.SRTR, RECESSIVE, 1)
        put(Field.IDE, RECESSIVE, 1)
        put(Field.ID17_13, identifier >> 13 & 0x1F, 5)
        put(Field.ID12_05, identifier >> 5 & 0xFF, 8)
        put(Field.ID04_00, identifier & 0x1F, 5)
        put(Field.RTR, remote, 1)
    else:
        put(Field.SRTR, remote, 1)
    arbitration = len(out.levels)
    if not extended:
        put(Field.IDE, DOMINANT, 1)
    fast_from = 0
    if fd:
        put(Field.RES1, RECESSIVE, 1)  # FDF
        put(Field.RES0, DOMINANT, 1)  # res
        put(Field.RES0, brs, 1)
        fast_from = len(out.levels)
        put(Field.RES0, esi, 1)
    else:
        put(Field.RES0, 0, 2 if extended else 1)
    put(Field.DLC, CAN_FD_LENGTHS.index(len(data)), 4)
    if not remote:
        put(Field.DATA, int.from_bytes(data), 8 * len(data))
    if fd:
        count = stuff_count(out.stuff_bits)
        counted = [*out.levels, *(count >> shift & 1 for shift in (3, 2, 1, 0))]
        check, width = frame_check(counted, True, len(data))
        out.put_fixed(count << width | check, 4 + width)
    else:
        put(Field.CRC, *frame_check(out.plain, False, 0))
        out.stuff()
    out.put(Field.CRC_DELIMITER, RECESSIVE, 1)
    fast = range(fast_from, len(out.levels)) if brs else range(0)
    ack = len(out.levels)
    out.put(Field.ACK, RECESSIVE, 1)
    out.put(Field.ACK_DELIMITER, RECESSIVE, 1)
    out.put(Field.EOF, 0x7F, _EOF_BITS)
    out.put(Field.INTERMISSION, 7, _INTERMISSION_BITS)
    return Bits(bytes(out.levels), bytes(out.fields), bytes(out.stuffed), arbitration, fast, ack)


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
        for _ in range(_EOF_BITS - 1):
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
