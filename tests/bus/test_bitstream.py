"""Bits on the wire against recordings of a real bus, published check values, and a hypothesis round trip."""

from itertools import groupby
from pathlib import Path

import pytest
from crccheck.crc import Crc15Can, Crc17CanFd, Crc21CanFd
from hypothesis import given
from hypothesis import strategies as st

from bus.bitstream import DOMINANT, Field, Kind, ViolationError, crc, encode, frame_check, stuff_count
from bus.frames import CAN_FD_LENGTHS, Frame
from bus.receiver import Receiver, decode
from bus.timing import TAIL, frame_bits
from tests.bus.frame_strategy import frames

RECORDED = Path(__file__).with_name("recorded_frames.txt")


def recordings() -> list[tuple[Frame, list[int]]]:
    found = []
    for line in RECORDED.read_text().splitlines():
        if line.startswith("#"):
            continue
        head, _, runs = line.partition("|")
        kind, address, identifier, data = head.split()
        content = b"" if data == "-" else bytes.fromhex(data)
        frame = Frame(int(identifier), content, kind != "classical", kind == "fd-brs", address == "extended")
        found.append((frame, [int(run) for run in runs.split()]))
    return found


@pytest.mark.parametrize("frame, runs", recordings(), ids=lambda v: f"{v.id:#x}" if isinstance(v, Frame) else "")
def test_bits_and_their_times_equal_those_recorded_on_a_real_bus(frame: Frame, runs: list[int]) -> None:
    """With the rate switched at the sample points, 80 %. Edges were sampled; the ACK comes a little late."""
    bits = encode(frame)
    slow, fast = 200, 50  # 2 µs and 0.5 µs
    durations = [fast if n in bits.fast else slow for n in range(bits.ack + 1)]
    if bits.fast:
        durations[bits.fast.start - 1] = round(0.8 * slow + 0.2 * fast)  # BRS
        durations[bits.fast.stop - 1] = round(0.8 * fast + 0.2 * slow)  # CRC delimiter
    levels = [*bits.levels[: bits.ack], DOMINANT]
    expected = [sum(d for _, d in run) for _, run in groupby(zip(levels, durations, strict=True), key=lambda b: b[0])]
    assert len(runs) == len(expected)
    assert all(abs(a - b) <= 12 for a, b in zip(runs, expected, strict=True)), (runs, expected)


def test_a_published_frame() -> None:
    """Tindell 2020, "canframe.py": identifier 0x014 with the one byte 0x01, CRC 0x7753, measured on a real bus."""
    bits = encode(Frame(0x014, b"\x01", fd=False, brs=False))
    without = [level for level, stuffed in zip(bits.levels, bits.stuffed, strict=True) if not stuffed]
    assert "".join(map(str, without)) == (
        "0" "00000010100" "0" "0" "0" "0001" "00000001" "111011101010011" "1" "1" "1" "1111111" "111"
    )  # fmt: skip
    assert [n for n, stuffed in enumerate(bits.stuffed) if stuffed] == [5, 16, 26]


CODES = [(0x4599, 15, Crc15Can), (0x1685B, 17, Crc17CanFd), (0x102899, 21, Crc21CanFd)]


@pytest.mark.parametrize("polynomial, width, catalogue", CODES)
@given(content=st.binary(max_size=80))
def test_codes_equal_those_of_the_catalogue(polynomial: int, width: int, catalogue: type, content: bytes) -> None:
    def bits_of(text: bytes) -> list[int]:
        return [byte >> shift & 1 for byte in text for shift in range(7, -1, -1)]

    check = {15: 0x059E, 17: 0x04F03, 21: 0x0ED841}[width]  # reveng's catalogue
    assert crc(bits_of(b"123456789"), polynomial, width, 0) == check
    assert crc(bits_of(content), polynomial, width, 0) == catalogue.calc(content)


@given(frames())
def test_a_frame_carries_the_code_of_its_bits(frame: Frame) -> None:
    """By the library's code, which starts at zero: dominant bits are put before, and a CAN FD register that starts
    with its top bit set is the same as a first bit that is set."""
    bits = encode(frame)
    end = bits.fields.index(Field.CRC)
    covered = [n for n in range(end) if frame.fd or not bits.stuffed[n]]
    field = [n for n in range(end, bits.ack - 1) if bits.fields[n] == Field.CRC and not bits.stuffed[n]]
    message = [bits.levels[n] for n in covered]
    found = [bits.levels[n] for n in field]
    if frame.fd:
        message[0] = 1
        message += found[:4]
        found = found[4:]
    code = Crc15Can if not frame.fd else Crc17CanFd if len(frame.data) <= 16 else Crc21CanFd
    value = int("".join(map(str, message)), 2)
    assert int("".join(map(str, found)), 2) == code.calc(value.to_bytes((len(message) + 7) // 8))


def test_stuff_counts_as_the_standard_lists_them() -> None:
    """ISO 11898-1:2015, table of the stuff bit count: Gray code and parity."""
    assert [f"{stuff_count(n):04b}" for n in range(9)] == [
        "0000", "0011", "0110", "0101", "1100", "1111", "1010", "1001", "0000",
    ]  # fmt: skip


@given(frames())
def test_every_frame_is_decoded_from_its_bits(frame: Frame) -> None:
    assert decode(encode(frame).levels) == frame


@given(frames())
def test_the_fast_count_equals_the_bits(frame: Frame) -> None:
    bits = encode(frame)
    slow, fast = frame_bits(frame)
    assert (len(bits.levels), len(bits.fast)) == (slow + fast + TAIL, fast)


@given(frames())
def test_no_six_equal_bits_before_the_end(frame: Frame) -> None:
    levels = encode(frame).levels[: encode(frame).ack]
    assert max(len(list(run)) for _, run in groupby(levels)) <= 5


@given(frames(), st.data())
def test_one_wrong_bit_never_yields_a_frame(frame: Frame, data: st.DataObject) -> None:
    """A receiver sees a single wrong bit anywhere in front of the ACK slot. RRS and SRR are the exceptions that the
    standard makes: their receivers do not look, only the code does."""
    bits = encode(frame)
    wrong = data.draw(st.integers(0, bits.ack - 1))
    levels = bytearray(bits.levels)
    levels[wrong] ^= 1
    with pytest.raises(ViolationError):
        decode(bytes(levels) + b"\x01" * 600)


@given(st.lists(st.integers(0, 1), max_size=800))
def test_any_levels_are_a_frame_or_a_violation(levels: list[int]) -> None:
    try:
        frame = decode(levels)
    except ViolationError:
        return
    assert bytes(levels).startswith(encode(frame).levels[:40])


def flipped(frame: Frame, place: str) -> ViolationError:
    bits = encode(frame)
    levels = bytearray(bits.levels)
    wrong = bits.place(place)
    assert wrong is not None
    levels[wrong] ^= 1
    with pytest.raises(ViolationError) as caught:
        decode(bytes(levels) + b"\x01" * 40)
    return caught.value


def test_each_kind_of_error_is_told_with_its_field() -> None:
    plain, fd = Frame(0x2AA, b"\x55\x55", fd=False, brs=False), Frame(0x2AA, b"\x55" * 20)
    cases = [
        (plain, "data:3", Kind.CRC, Field.CRC), (plain, "crc:2", Kind.CRC, Field.CRC),
        (plain, "crc_delimiter", Kind.FORM, Field.CRC_DELIMITER), (plain, "eof:2", Kind.FORM, Field.EOF),
        (plain, "ack_delimiter", Kind.FORM, Field.ACK_DELIMITER), (fd, "data:77", Kind.CRC, Field.CRC),
    ]  # fmt: skip
    for frame, place, kind, field in cases:
        violation = flipped(frame, place)
        assert (violation.kind, violation.field) == (kind, field), (place, violation)
    stuffed = Frame(0x000, b"", fd=False, brs=False)  # SOF and the identifier need a stuff bit at once
    levels = bytearray(encode(stuffed).levels)
    levels[5] = DOMINANT
    with pytest.raises(ViolationError) as caught:
        decode(bytes(levels))
    assert (caught.value.kind, caught.value.field) == (Kind.STUFF, Field.ID28_21)
    fixed = encode(fd).fields.index(Field.CRC)
    levels = bytearray(encode(fd).levels)
    levels[fixed] ^= 1
    with pytest.raises(ViolationError) as caught:
        decode(bytes(levels))
    assert (caught.value.kind, caught.value.field) == (Kind.FORM, Field.CRC)


def test_a_dominant_last_bit_of_eof_is_an_overload_and_no_error() -> None:
    bits = encode(Frame(0x123, b"\x01", fd=False, brs=False))
    receiver = Receiver()
    for level in [*bits.levels[: bits.eof - 1], DOMINANT]:
        receiver.push(level)
    assert receiver.frame is not None and receiver.overload


def test_places_are_named_by_field_and_number() -> None:
    bits = encode(Frame(0x123, bytes(8), fd=False, brs=False))
    assert bits.place("sof") == bits.place(0) == 0
    assert bits.place("ack") == bits.ack
    assert bits.place("eof:6") == bits.eof - 1
    assert bits.place("data:64") is None and bits.place(500) is None


def test_the_code_covers_the_length_where_it_changes() -> None:
    assert frame_check([0, 1] * 80, True, 16)[1] == 17 and frame_check([0, 1] * 80, True, 20)[1] == 21
    assert {n for n in CAN_FD_LENGTHS if frame_check([0], True, n)[1] == 21} == {20, 24, 32, 48, 64}
