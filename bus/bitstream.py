"""The bits of a CAN frame as they run over the wire (ISO 11898-1:2015, 10.4 and 10.5); back: ``bus.receiver``.

This is the reference: written for reading, bit by bit. What needs to be fast, the number of a frame's bits, is
counted by ``bus.timing`` and ``bus.stuffing`` without building them, and is tested to be equal.

A level is 0 (dominant) or 1 (recessive). The fields carry the numbers of SocketCAN's ``CAN_ERR_PROT_LOC_*``,
which are those of the SJA1000's error code capture and know no CAN FD: FDF, res, BRS and ESI count as reserved bits.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

from bus.frames import CAN_FD_LENGTHS, Frame, checked

DOMINANT, RECESSIVE = 0, 1
EOF_BITS, _INTERMISSION_BITS = 7, 3


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
    out.put(Field.EOF, 0x7F, EOF_BITS)
    out.put(Field.INTERMISSION, 7, _INTERMISSION_BITS)
    return Bits(bytes(out.levels), bytes(out.fields), bytes(out.stuffed), arbitration, fast, ack)
