"""How long a frame occupies the bus, exactly, from its bits and their stuff bits (ISO 11898-1:2015).

Bit fields, and the rate at which they run::

    classical   SOF  identifier (11, or 11 SRR IDE 18)  RTR IDE r0  DLC 4  data  CRC 15  | delimiter 1
    CAN FD      SOF  identifier (11, or 11 SRR IDE 18)  RRS IDE FDF res BRS              arbitration rate
                ESI  DLC 4  data  |  stuff count 4  CRC 17 or 21, a fixed stuff bit      data rate, when BRS
                before them and after every fourth of them  |  delimiter 1
    both        ACK 1  delimiter 1  EOF 7  intermission 3                                arbitration rate

A remote frame has no data. The part left of the first bar is stuffed dynamically. The rate is switched at the
sample point of BRS and, back, at that of the CRC delimiter. Whatever the two rates' sample
points are, these two bits together last one bit time of either rate: BRS is counted wholly at the arbitration
rate, the CRC delimiter wholly at the data rate, and the sum is exact.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

from bus import stuffing
from bus.frames import CAN_FD_LENGTHS, Frame, checked

INTERMISSION = 3
TAIL = 1 + 1 + 7 + INTERMISSION  # ACK, its delimiter, end of frame, intermission
_DLC = {length: code for code, length in enumerate(CAN_FD_LENGTHS)}
_SECOND = 10**9


class FrameBits(NamedTuple):
    """Bits of a frame before its tail: ``slow`` at the arbitration rate, then ``fast`` at the data rate."""

    slow: int
    fast: int


class _Prefix(NamedTuple):
    """What all frames of one identifier and length have in common."""

    priority: int
    state: int  # of the stuffing, after the DLC
    crc: int  # CRC-15 after the DLC, classical frames only
    slow: int  # bits before the tail, all but the stuff bits that depend on the data
    fast: int
    switches: bool


def _crc15(crc: int, value: int, width: int) -> int:
    for shift in range(width - 1, -1, -1):
        feedback = (crc >> 14 ^ value >> shift) & 1
        crc = crc << 1 & 0x7FFF ^ (0x4599 if feedback else 0)
    return crc


_CRC15 = [_crc15(0, byte, 8) for byte in range(256)]


@lru_cache(maxsize=4096)
def _prefix(
    identifier: int, length: int, fd: bool, brs: bool, extended: bool, remote: bool, esi: bool
) -> _Prefix:
    checked(Frame(identifier, bytes(length), fd, brs, extended, remote, esi))
    if extended:  # base identifier, SRR and IDE recessive, extension, RTR (RRS)
        head, width = ((identifier >> 18) << 20 | 3 << 18 | (identifier & 0x3FFFF)) << 1 | remote, 32
    else:  # identifier, RTR (RRS), IDE dominant
        head, width = identifier << 2 | remote << 1, 13
    priority = head << 32 - width
    if fd:  # FDF recessive, res dominant, BRS; then ESI (recessive: error passive) and DLC
        state, stuffed_slow = stuffing.after_bits(stuffing.START, head << 3 | 4 | brs, width + 3)
        state, stuffed_fast = stuffing.after_bits(state, esi << 4 | _DLC[length], 5)
        slow = 1 + width + 3 + stuffed_slow
        check = 4 + (17 if length <= 16 else 21)
        fixed_stuff = 1 + check // 4
        fast = 5 + stuffed_fast + 8 * length + check + fixed_stuff + 1
        return (
            _Prefix(priority, state, 0, slow, fast, True) if brs else _Prefix(priority, state, 0, slow + fast, 0, False)
        )
    control = 6 if extended else 5  # r1, r0 and DLC
    head, width = head << control | length, width + control
    state, stuffed = stuffing.after_bits(stuffing.START, head, width)
    data_bits = 0 if remote else 8 * length
    return _Prefix(priority, state, _crc15(0, head, width), 1 + width + stuffed + data_bits + 15 + 1, 0, False)


def contender(frame: Frame) -> tuple[int, int, int]:
    """What the wire needs to know of a frame: its priority in arbitration and its bits as ``frame_bits`` has them.

    The priority is the arbitration field as a number, the lowest wins: the first bit that differs decides. So data
    beats remote, and a base frame an extended one with the same first eleven bits. Raises InvalidFrameError for
    an impossible frame.
    """
    identifier, data, fd, brs, extended, remote, esi = frame
    priority, state, crc, slow, fast, switches = _prefix(identifier, len(data), fd, brs, extended, remote, esi)
    if remote:
        data = b""  # only its length was sent
    state, stuffed = stuffing.after_bytes(state, data)
    if switches:
        return priority, slow, fast + stuffed
    if fd:
        return priority, slow + stuffed, 0
    table = _CRC15
    for byte in data:
        crc = (crc << 8 & 0x7FFF) ^ table[crc >> 7 ^ byte]
    state, stuffed_crc = stuffing.after_15_bits(state, crc)
    return priority, slow + stuffed + stuffed_crc + stuffing.pending(state), 0


def frame_bits(frame: Frame) -> FrameBits:
    """Bits of ``frame`` before its tail of TAIL bits, per rate. Raises InvalidFrameError for an impossible
    frame."""
    return FrameBits(*contender(frame)[1:])


class BitRates:
    """The two bit rates of a bus (bit/s), to turn bits into whole nanoseconds without rounding on the way."""

    __slots__ = ("_denominator", "_fast", "_slow")

    def __init__(self, arbitration: float, data: float) -> None:
        slow, fast = _SECOND / Fraction(arbitration), _SECOND / Fraction(data)
        self._denominator = slow.denominator * fast.denominator
        self._slow = slow.numerator * fast.denominator
        self._fast = fast.numerator * slow.denominator

    def ns(self, slow: int, fast: int = 0) -> int:
        """Time of ``slow`` bits at the arbitration rate and ``fast`` at the data rate, ns, rounded up."""
        return -(-(slow * self._slow + fast * self._fast) // self._denominator)

    def lengths(self) -> tuple[int, int, int]:
        """A bit at the arbitration rate, one at the data rate and a nanosecond, in a unit that makes them whole."""
        return self._slow, self._fast, self._denominator


_rates = lru_cache(maxsize=16)(BitRates)


def frame_ns(frame: Frame, arbitration_rate: float, data_rate: float) -> int:
    """Time from the start of ``frame`` until the bus is idle again (intermission included), ns, rounded up.

    Rates in bit/s. Raises InvalidFrameError for a frame that no controller could send.
    """
    slow, fast = frame_bits(frame)
    return _rates(arbitration_rate, data_rate).ns(slow + TAIL, fast)
