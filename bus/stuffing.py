"""Counts the stuff bits of CAN: after five equal bits the sender inserts one of the other value (ISO
11898-1).

A stuff bit is counted when the bit after it is sent. So the count of a CAN FD frame's dynamically stuffed
part is right as it stands (a fixed stuff bit follows it in any case), and a classical frame, whose CRC may
end in a stuff bit, adds ``pending(state)``.

A *state* is ``8 * (5 * last bit + run length - 1)`` plus, in its lowest three bits, the number of stuff bits
that the last step inserted.
"""

from __future__ import annotations

import struct

import numpy as np

START = 0  # after the dominant start-of-frame bit


def _step(position: int, bit: int) -> tuple[int, int]:
    """Next (last bit, run) position in 0 … 9 and stuff bits inserted, for one more bit."""
    last, run = position // 5, position % 5 + 1
    stuffed = run == 5
    if stuffed:
        last, run = 1 - last, 1
    run = run + 1 if bit == last else 1
    return 5 * bit + run - 1, int(stuffed)


def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States after seven bits (10 × 128), after a byte (10 × 256), and after two bytes (10 × 65536, indexed
    by the pair as a native 16-bit word)."""
    position = np.arange(10)[:, None]  # after no bit at all
    count = np.zeros((10, 1), dtype=np.int64)
    step = np.array([[_step(p, bit) for bit in (0, 1)] for p in range(10)])
    by_width = []
    for _ in range(8):  # each pass appends one bit: the number of words doubles
        position, count = (
            step[position][..., 0].reshape(10, -1),
            (count[..., None] + step[position][..., 1]).reshape(10, -1),
        )
        by_width.append(8 * position + count)
    seven, byte = by_width[6:]
    first, second = byte[:, :, None], byte[byte // 8]
    pair = (second + (first & 7)).reshape(10, -1)
    words = np.stack(np.divmod(np.arange(65536), 256), axis=1).astype(np.uint8).view(np.uint16).ravel()
    pair_by_word = np.empty_like(pair)
    pair_by_word[:, words] = pair
    return seven.astype(np.uint8), byte.astype(np.uint8), pair_by_word.astype(np.uint8)


_seven, _byte, _pair = _tables()
_SEVENS = [_seven[state >> 3].tobytes() for state in range(80)]
_BYTES = [_byte[state >> 3].tobytes() for state in range(80)]
_per_position = [row.tobytes() for row in _pair]
_PAIRS = [_per_position[state >> 3] for state in range(80)]


def after_bits(state: int, value: int, width: int) -> tuple[int, int]:
    """State and number of stuff bits after the ``width`` bits of ``value``, most significant first."""
    position, count = state >> 3, 0
    for shift in range(width - 1, -1, -1):
        position, stuffed = _step(position, value >> shift & 1)
        count += stuffed
    return position << 3, count


_WORDS = [struct.Struct(f"{length // 2}H").unpack for length in range(65)]


def after_bytes(state: int, data: bytes) -> tuple[int, int]:
    """State and number of stuff bits after the bytes of ``data``, at most 64."""
    if len(data) & 1:
        state, count = after_bytes(state, data[:-1])
        state = _BYTES[state][data[-1]]
        return state, count + (state & 7)
    count = 0
    pairs = _PAIRS
    for word in _WORDS[len(data)](data):
        state = pairs[state][word]
        count += state & 7
    return state, count


def after_15_bits(state: int, value: int) -> tuple[int, int]:
    """As ``after_bits(state, value, 15)``, fast."""
    first = _BYTES[state][value >> 7]
    state = _SEVENS[first][value & 0x7F]
    return state, (first & 7) + (state & 7)


def pending(state: int) -> int:
    """1 if the bits so far end in five equal ones, so that a stuff bit follows; else 0."""
    return int((state >> 3) % 5 == 4)
