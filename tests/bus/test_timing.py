"""Frame durations against a sender that writes out every bit, and against published bounds."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.frames import CAN_FD_LENGTHS, Frame, InvalidFrameError
from bus.timing import TAIL, BitRates, frame_bits, frame_ns
from tests.bus.frame_strategy import contents, frames, identifiers

# --- an independent sender: lists of (bit, rate) ------------------------------------------------------------


def bits_of(value: int, width: int) -> list[int]:
    return [int(c) for c in format(value, f"0{width}b")] if width else []


def stuffed(sequence: list[tuple[int, str]], final: bool) -> list[tuple[int, str]]:
    """``sequence`` with dynamic stuff bits, each at the rate in force; ``final``: also after the last bit."""
    out: list[tuple[int, str]] = []
    for n, (bit, rate) in enumerate(sequence):
        out.append((bit, rate))
        tail = [b for b, _ in out[-5:]]
        if len(tail) == 5 and len(set(tail)) == 1 and (final or n + 1 < len(sequence)):
            next_rate = sequence[n + 1][1] if n + 1 < len(sequence) else rate
            out.append((1 - bit, next_rate))
    return out


def crc15(sequence: list[int]) -> int:
    """CRC by polynomial division with x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1."""
    polynomial = sum(1 << n for n in (15, 14, 10, 8, 7, 4, 3, 0))
    value = int("0" + "".join(map(str, sequence)), 2) << 15
    for position in range(value.bit_length() - 1, 14, -1):
        if value >> position & 1:
            value ^= polynomial << (position - 15)
    return value


def whole_frame(frame: Frame) -> list[tuple[int, str]]:
    slow, fast = "slow", "fast" if frame.brs else "slow"
    if frame.extended:
        address = [0, *bits_of(frame.id >> 18, 11), 1, 1, *bits_of(frame.id & 0x3FFFF, 18), int(frame.remote)]
    else:
        address = [0, *bits_of(frame.id, 11), int(frame.remote), 0]
    payload = [] if frame.remote else [b for byte in frame.data for b in bits_of(byte, 8)]
    dlc = bits_of(CAN_FD_LENGTHS.index(len(frame.data)), 4)
    tail = [(1, slow)] * (1 + 1 + 7 + 3)
    if not frame.fd:
        unstuffed = [*address, *[0] * (2 if frame.extended else 1), *dlc, *payload]
        unstuffed += bits_of(crc15(unstuffed), 15)
        return [*stuffed([(b, slow) for b in unstuffed], final=True), (1, slow), *tail]
    head = [(b, slow) for b in [*address, 1, 0, int(frame.brs)]]
    dynamic = stuffed([*head, *[(b, fast) for b in [int(frame.esi), *dlc, *payload]]], final=False)
    check = [0] * (4 + (17 if len(frame.data) <= 16 else 21))  # their values do not matter to the length
    checked: list[tuple[int, str]] = []
    for n, bit in enumerate(check):
        if n % 4 == 0:
            checked.append((1, fast))
        checked.append((bit, fast))
    if len(check) % 4 == 0:
        checked.append((1, fast))
    return dynamic + checked + [(1, fast)] + tail


def check_bits(frame: Frame) -> None:
    sequence = whole_frame(frame)
    slow = sum(rate == "slow" for _, rate in sequence)
    bits = frame_bits(frame)
    assert (bits.slow + TAIL, bits.fast) == (slow, len(sequence) - slow), frame


@given(frames())
def test_bits_equal_those_of_a_sender_that_writes_every_bit(frame: Frame) -> None:
    check_bits(frame)


@pytest.mark.parametrize("length", CAN_FD_LENGTHS)
@pytest.mark.parametrize("extended", [False, True])
def test_every_length_of_every_format(length: int, extended: bool) -> None:
    data = bytes((37 * n + 11) & 0xFF for n in range(length))
    for brs in (False, True):
        check_bits(Frame(0x2AA, data, True, brs, extended))
    if length <= 8:
        check_bits(Frame(0x2AA, data, False, False, extended))


def test_a_crc_that_ends_in_five_equal_bits_is_stuffed_before_its_delimiter() -> None:
    contents = [Frame(0x123, bytes([byte]), fd=False, brs=False) for byte in range(256)]
    stuffed_at_the_end = 0
    for frame in contents:
        check_bits(frame)
        before_delimiter = [bit for bit, _ in whole_frame(frame)][: -TAIL - 1]
        stuffed_at_the_end += len(set(before_delimiter[-6:-1])) == 1
    assert stuffed_at_the_end > 0  # the case occurs among them


@given(st.booleans().flatmap(lambda extended: st.tuples(st.just(extended), identifiers(extended))),
       st.integers(0, 8).flatmap(contents))  # fmt: skip
def test_classical_frames_stay_below_the_analytic_bound(address: tuple[bool, int], data: bytes) -> None:
    """Davis et al. 2007, (1): 55 + 10 n and 80 + 10 n bits, intermission included."""
    extended, identifier = address
    bits = frame_bits(Frame(identifier, data, fd=False, brs=False, extended=extended)).slow + TAIL
    shortest = (67 if extended else 47) + 8 * len(data)
    assert shortest <= bits <= (80 if extended else 55) + 10 * len(data)


@pytest.mark.parametrize("length, limit", [(8, 56_600), (16, 72_600), (32, 105_600), (64, 169_600)])
def test_can_fd_frames_stay_below_the_published_bound(length: int, limit: int) -> None:
    """Bordoloi and Samii 2014: (32 + 3) arbitration and 28 + 5 ceil((p - 16)/64) + 10 p data bit times."""

    @given(identifiers(False), contents(length))
    def check(identifier: int, data: bytes) -> None:
        assert frame_ns(Frame(identifier, data), 1e6, 5e6) <= limit

    check()
    for byte in (0x00, 0xFF, 0x0F, 0x78, 0x87, 0x1E, 0xE1, 0xC3, 0x3C):
        assert frame_ns(Frame(0x078, bytes([byte]) * length), 1e6, 5e6) <= limit


def test_a_worked_example_of_each_kind() -> None:
    """Contents without any stuff bit: 0x55 everywhere, an identifier and lengths without five equal bits."""
    data = b"\x55" * 8
    assert frame_bits(Frame(0x2AA, data)) == (17, 5 + 64 + 27 + 1)
    assert frame_bits(Frame(0x2AA, b"\x55" * 64)) == (17, 5 + 512 + 32 + 1)
    assert frame_bits(Frame(0x2AA, data, brs=False)) == (17 + 97, 0)
    assert frame_ns(Frame(0x2AA, data), 1e6, 5e6) == (17 + 12) * 1000 + 97 * 200


@given(st.integers(0, 200), st.integers(0, 700),
       st.sampled_from([1e6, 5e5, 83_333.0, 8e5]), st.sampled_from([5e6, 3e6]))  # fmt: skip
def test_times_are_rounded_up_once(slow: int, fast: int, arbitration: float, data: float) -> None:
    exact = slow * 10**9 / arbitration + fast * 10**9 / data
    ns = BitRates(arbitration, data).ns(slow, fast)
    assert ns == math.ceil(exact - 1e-6) or ns == math.ceil(exact)


@pytest.mark.parametrize("frame", [
    Frame(0x800, b""), Frame(-1, b""), Frame(2**29, b"", extended=True), Frame(1, bytes(9)),
    Frame(1, bytes(9), fd=False, brs=False), Frame(1, b"", fd=False, brs=True),
    Frame(1, b"", remote=True), Frame(1, b"", fd=False, brs=False, esi=True),
])  # fmt: skip
def test_impossible_frames_are_refused(frame: Frame) -> None:
    with pytest.raises(InvalidFrameError):
        frame_bits(frame)
