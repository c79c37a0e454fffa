"""Logs of a bus, each read back by readers that others wrote: python-can, scapy, Wireshark's tshark, can-utils."""

import io
import itertools
import random
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import pytest
from cantools.logreader import Parser
from hypothesis import given, settings
from hypothesis import strategies as st
from scapy.layers.can import CAN, CANFD
from scapy.utils import PcapReader

from bus.candump import format_line
from bus.frames import CAN_FD_LENGTHS, ErrorFrame, Frame
from bus.logs import FORMATS, Entry, open_log

EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000


@st.composite
def frames(draw: st.DrawFn) -> Frame | ErrorFrame:
    kind = draw(st.sampled_from(["classical", "remote", "fd", "error"]))
    if kind == "error":
        return ErrorFrame(draw(st.integers(1, 0x3FF)), draw(st.binary(min_size=8, max_size=8)))
    extended = draw(st.booleans())
    identifier = draw(st.integers(0, 2 ** (29 if extended else 11) - 1))
    length = draw(st.sampled_from(CAN_FD_LENGTHS if kind == "fd" else range(9)))
    data = bytes(length) if kind == "remote" else draw(st.binary(min_size=length, max_size=length))
    if kind == "fd":
        return Frame(identifier, data, True, draw(st.booleans()), extended, False, draw(st.booleans()))
    return Frame(identifier, data, False, False, extended, kind == "remote")


@st.composite
def entries(draw: st.DrawFn) -> list[Entry]:
    steps = draw(st.lists(st.tuples(st.integers(0, 3 * 10**9), frames()), max_size=12))
    times = itertools.accumulate(step for step, _ in steps)
    return list(zip(times, [frame for _, frame in steps], strict=True))


def one_of_each() -> list[Entry]:
    """Every kind of frame, with content that is not the same when it is shifted or swapped; reproducible."""
    numbers = random.Random(1)
    frames: list[Frame | ErrorFrame] = []
    for extended, identifiers in ((False, (0, 0x123, 0x7FF)), (True, (0, 0x1ABCDEF, 0x1FFFFFFF))):
        for identifier in identifiers:
            frames += [Frame(identifier, numbers.randbytes(n), False, False, extended) for n in range(9)]
            frames += [Frame(identifier, bytes(n), False, False, extended, True) for n in (0, 4, 8)]
            frames += [
                Frame(identifier, numbers.randbytes(n), True, brs, extended, False, esi)
                for n in CAN_FD_LENGTHS[1:] for brs in (False, True) for esi in (False, True)
            ]  # fmt: skip
    frames += [ErrorFrame(1 << n, numbers.randbytes(8)) for n in range(9)]
    return [(n * 10**9 // 7 + n, frame) for n, frame in enumerate(frames)]


def written(name: str, entries: Sequence[Entry], directory: Path) -> Path:
    path = directory / f"bus.{name}"
    log = open_log(name, path, 3)
    for n in range(0, len(entries), 5):  # as flushes come
        log.write(entries[n : n + 5])
    log.close()
    return path


def run(package: str, *command: str | Path, **options: Any) -> str:
    """Output of a stock tool; without it the test says so and is counted as skipped."""
    if shutil.which(command[0]) is None:
        pytest.skip(f"{command[0]} is not here: apt-get install {package}")
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60, **options).stdout


def as_frame(message: can.Message) -> Frame | ErrorFrame:
    if message.is_error_frame:
        return ErrorFrame(message.arbitration_id, bytes(message.data))
    remote = message.is_remote_frame
    data = bytes(message.dlc) if remote else bytes(message.data)
    return Frame(message.arbitration_id, data, message.is_fd, message.bitrate_switch, message.is_extended_id, remote,
                 message.error_state_indicator)  # fmt: skip


Read = Callable[[Path], Iterator[can.Message]]


# --- PCAP -------------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(entries())
def test_scapy_reads_pcap_back(entries: list[Entry]) -> None:
    with tempfile.TemporaryDirectory() as directory, PcapReader(str(written("pcap", entries, Path(directory)))) as file:
        assert file.nano and file.linktype == 227
        read = list(file)
    for (time_ns, frame), packet in zip(entries, read, strict=True):
        assert round(packet.time * 10**9) == time_ns
        flags = str(packet.flags).split("+") if packet.flags else []
        if isinstance(frame, ErrorFrame):
            assert flags == ["error"]
            assert (packet.identifier, packet.data) == frame
            continue
        assert (packet.identifier, packet.length, packet.data) == (frame.id, len(frame.data), frame.data)
        assert ("extended" in flags, "remote_transmission_request" in flags) == (frame.extended, frame.remote)
        assert type(packet) is (CANFD if frame.fd else CAN)
        if frame.fd:
            told = {"bit_rate_switch": frame.brs, "error_state_indicator": frame.esi, "fd_frame": True}
            assert set(str(packet.fd_flags).split("+")) == {name for name, flag in told.items() if flag}


_FIELDS = [
    "frame.time_epoch", "frame.protocols", "can.id", "can.len", "can.flags.xtd", "can.flags.rtr", "can.flags.err",
    "canfd.flags.brs", "canfd.flags.esi", "data.data", "can.err.ctrl", "can.err.prot", "can.err.busoff",
]  # fmt: skip


def test_wireshark_reads_pcap(tmp_path: Path) -> None:
    entries = one_of_each()
    path = written("pcap", entries, tmp_path)
    fields = [option for field in _FIELDS for option in ("-e", field)]
    guess = ("--disable-protocol", "autosar-nm")  # Wireshark takes some identifiers for it
    lines = run("tshark", "tshark", "-r", path, *guess, "-T", "fields", *fields).splitlines()
    for (time_ns, frame), line in zip(entries, lines, strict=True):
        read = dict(zip(_FIELDS, line.split("\t"), strict=True))
        assert read["frame.time_epoch"] == f"{time_ns // 10**9}.{time_ns % 10**9:09d}"
        if isinstance(frame, ErrorFrame):
            assert read["can.flags.err"] == "1"
            for field, bit in (("can.err.ctrl", 4), ("can.err.prot", 8), ("can.err.busoff", 0x40)):
                assert read[field] == str(int(frame.classes == bit)), (frame, read)
            continue
        assert (int(read["can.id"]), int(read["can.len"])) == (frame.id, len(frame.data))
        assert read["can.flags.xtd"] == str(int(frame.extended)) and read["data.data"] == frame.data.hex()
        if frame.fd:
            assert (read["canfd.flags.brs"], read["canfd.flags.esi"]) == (str(int(frame.brs)), str(int(frame.esi)))
            assert read["can.flags.rtr"] == ""
        else:
            assert (read["can.flags.rtr"], read["can.flags.err"]) == (str(int(frame.remote)), "0")
            assert read["canfd.flags.brs"] == ""


# --- BLF and ASC ------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(entries())
def test_python_can_reads_all_of_blf_back(entries: list[Entry]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        read = list(can.BLFReader(written("blf", entries, Path(directory))))
    assert [(round(m.timestamp * 1e9), as_frame(m)) for m in read] == entries
    assert {m.channel for m in read} <= {2}  # python-can counts from 0, the file from 1


def test_a_blf_that_was_never_closed_lacks_16_kb_at_most(tmp_path: Path) -> None:
    entries: list[Entry] = [(n * 1000, Frame(0x123, bytes(64))) for n in range(1000)]
    log = open_log("blf", tmp_path / "bus.blf", 1)
    log.write(entries)
    read = list(can.BLFReader(tmp_path / "bus.blf"))
    assert 0 <= len(entries) - len(read) <= 16 * 1024 / 128
    assert [as_frame(m) for m in read] == [frame for _, frame in entries[: len(read)]]
    log.close()


def survives_asc(frame: Frame | ErrorFrame) -> Frame | ErrorFrame:
    """ASC has no content of error frames; python-can's reader takes CAN FD without data for a remote frame."""
    if isinstance(frame, ErrorFrame):
        return ErrorFrame(0, b"")
    return frame._replace(remote=True) if frame.fd and not frame.data else frame


@settings(max_examples=40, deadline=None)
@given(entries())
def test_python_can_reads_asc_back_to_the_microsecond(entries: list[Entry]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        read = list(can.ASCReader(written("asc", entries, Path(directory))))
    assert [as_frame(message) for message in read] == [survives_asc(frame) for _, frame in entries]
    for (time_ns, _), message in zip(entries, read, strict=True):
        assert message.timestamp == pytest.approx(time_ns * 1e-9, abs=0.501e-6)


def test_can_utils_reads_asc(tmp_path: Path) -> None:
    """It has no flag FDF, and does not know what an error frame is about."""
    entries = one_of_each()
    lines = run("can-utils", "asc2log", "-I", written("asc", entries, tmp_path)).splitlines()
    read = [line.split() for line in lines]
    assert len(read) == len(entries)
    start = float(read[0][0][1:-1])
    for (time_ns, frame), (stamp, channel, body, *_) in zip(entries, read, strict=True):
        assert float(stamp[1:-1]) - start == pytest.approx(time_ns * 1e-9, abs=2e-6) and channel == "can2"
        expected = format_line(0, "x", frame).split()[2]
        if isinstance(frame, ErrorFrame):
            expected = "20000080#" + 16 * "0"
        elif frame.fd:
            identifier, _, content = expected.partition("##")
            expected = f"{identifier}##{frame.brs | frame.esi << 1}{content[1:]}"
        assert body == expected


# --- candump ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame, body", [
    (Frame(0x123, b"", False, False, False, True), "123#R"),
    (Frame(0x123, bytes(4), False, False, False, True), "123#R4"),
    (Frame(0x123, bytes(8), False, False, True, True), "00000123#R8"),
    (Frame(0x1, b"\xab", True, False, False, False, True), "001##6AB"),
    (Frame(0x1, b"\xab", True, True, True, False, True), "00000001##7AB"),
    (ErrorFrame(0x88, bytes.fromhex("0000040800000809")), "20000088#0000040800000809"),
    (ErrorFrame(0x40, bytes(8)), "20000040#0000000000000000"),
])  # fmt: skip
def test_lines_are_as_candump_writes_them(frame: Frame | ErrorFrame, body: str) -> None:
    """Bodies as sprint_canframe() of can-utils (lib.c) makes them."""
    assert format_line(1_000_000_023, "left_leg", frame) == f"(1.000000023) left_leg {body}"


@given(st.integers(0, 10**13), frames())
def test_python_can_reads_a_line_back(time_ns: int, frame: Frame | ErrorFrame) -> None:
    """Its reader knows an error frame by the class BUSERROR, and keeps nothing else of it."""
    (read,) = can.CanutilsLogReader(io.StringIO(format_line(time_ns, "left_leg", frame) + "\n"))
    assert round(read.timestamp * 1e9) == time_ns
    if not isinstance(frame, ErrorFrame):
        assert as_frame(read) == frame
    elif frame.classes & 0x80:
        assert read.is_error_frame


@pytest.mark.parametrize("body, kind", [
    ("123#R4", "remote"), ("001##6AB", "data"), ("20000088#0000040800000809", None),
])  # fmt: skip
def test_cantools_reads_a_line(body: str, kind: str | None) -> None:
    """It passes over error frames, and keeps no DLC of remote frames."""
    read = Parser(io.StringIO()).parse(f"(1.000000023) left_leg {body}")
    assert (read and ("remote" if read.is_remote_frame else "data")) == kind


def test_can_utils_reads_a_log(tmp_path: Path) -> None:
    """Kind, identifier and content; for log2asc the digits after the point are microseconds, so not its times."""
    entries = one_of_each()
    log = tmp_path / "bus.log"
    log.write_text("".join(format_line(t, "left_leg", frame) + "\n" for t, frame in entries))
    output = run("can-utils", "log2asc", "-I", log, "left_leg")
    body = [line for line in output.splitlines() if "Rx" in line or "ErrorFrame" in line]
    text = "date Thu Jan 01 00:00:00 1970\nbase hex  timestamps absolute\nno internal events logged\n"
    read = [as_frame(m) for m in can.ASCReader(io.StringIO(text + "\n".join(body)))]
    assert read == [survives_asc(frame) for _, frame in entries]


def test_every_format_is_offered_by_the_command() -> None:
    from hil.cli import _parser

    options = _parser().parse_args(["run", "stand", *(f"--log-format={name}" for name in FORMATS)])
    assert options.log_formats == list(FORMATS)
