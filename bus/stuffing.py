"""Counts the stuff bits of CAN: after five equal bits the sender inserts one of the other value (ISO
11898-1).

A stuff bit is counted when the bit after it is sent. So the count of a CAN FD frame's dynamically stuffed
part is right as it stands (a fixed stuff bit follows it in any case), and a classical frame, whose CRC may
end in a stuff bit, adds ``pending(state)``.

A *state* is ``8 * (5 * last bit + run length - 1)`` plus, in its lowest three bits, the number of stuff bits
that the last step inserted.
"""

from __future__ import annotations

START = 0  # after the dominant start-of-frame bit


def _step(position: int, bit: int) -> tuple[int, int]:
    """Next (last bit, run) position in 0 … 9 and stuff bits inserted, for one more bit."""
    last, run = position // 5, position % 5 + 1
    stuffed = run == 5
    if stuffed:
        last, run = 1 - last, 1
    run = run + 1 if bit == last else 1
    return 5 * bit + run - 1, int(stuffed)


def _words(width: int) -> list[bytes]:
    """By state: the states after each word of ``width`` bits."""
    rows = []
    for position in range(10):
        row = [(position, 0)]
        for _ in range(width):  # each pass appends one bit: the number of words doubles
            row = [(after, count + stuffed) for at, count in row for after, stuffed in (_step(at, 0), _step(at, 1))]
        rows.append(bytes(8 * after + count for after, count in row))
    return [rows[state >> 3] for state in range(80)]


_SEVENS, _BYTES = _words(7), _words(8)


def after_bits(state: int, value: int, width: int) -> tuple[int, int]:
    """State and number of stuff bits after the ``width`` bits of ``value``, most significant first."""
    position, count = state >> 3, 0
    for shift in range(width - 1, -1, -1):
        position, stuffed = _step(position, value >> shift & 1)
        count += stuffed
    return position << 3, count


def after_bytes(state: int, data: bytes) -> tuple[int, int]:
    """State and number of stuff bits after the bytes of ``data``."""
    count = 0
    after = _BYTES
    for byte in data:
        state = after[state][byte]
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
