"""The record: stock tools read it, a killed run's is complete to its end, and the digest sees every byte."""

import io
import struct
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from bus.frames import ErrorFrame, Frame
from hil.errors import UserError
from hil.record.mcap_writer import McapWriter, field_names
from hil.record.recorder import Recorder, RowRecorder
from hil.record.signals import SIGNALS_FILE, Signals, UnknownSignalError, load_tables

CHANNELS = {"world": ["com.x", "com.z", "q.left_knee"], "drives": ["error.left_knee"]}
BUSES = ["left_leg", "right_leg"]
ROWS = np.random.default_rng(1).normal(size=(6, 3))
TIMES = np.array([0, 333_333, 666_666, 10**9, 2 * 10**9, 2**40], np.int64)


def write(directory: Path | None, flush_after: tuple[int, ...] = (2, 3), close: bool = True) -> Recorder:
    """Six rows of each channel and some frames, flushed in between."""
    recorder = Recorder(directory, CHANNELS, BUSES)
    for n, (time, row) in enumerate(zip(TIMES.tolist(), ROWS, strict=True)):
        recorder.channel("world").append(time, row)
        recorder.channel("drives").append(time + 5, row[:1])
        recorder.frame(time, n % 2, Frame(0x184, bytes([n] * 8), True, True, False))
        if n in flush_after:
            recorder.flush(time)
    if close:
        recorder.close()
    return recorder


def test_the_stock_reader_finds_every_value_under_its_name(tmp_path: Path) -> None:
    write(tmp_path)
    with (tmp_path / SIGNALS_FILE).open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 12
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (0, 2**40 + 5)
        world = [(m.log_time, d) for _, _, m, d in reader.iter_decoded_messages(topics=["/world"])]
        some = list(reader.iter_messages(topics=["/drives"], starting_at=666_671, ending_before=2 * 10**9))
        named = {m.name: m.metadata for m in reader.iter_metadata()}
    assert [time for time, _ in world] == TIMES.tolist()
    assert [[d.com_x, d.com_z, d.q_left_knee] for _, d in world] == ROWS.tolist()
    assert [message.log_time for _, _, message in some] == [666_671, 10**9 + 5]
    assert named["signals/world"]["q_left_knee"] == "q.left_knee"


def test_signals_reads_what_was_recorded(tmp_path: Path) -> None:
    recorder = write(tmp_path)
    tables = load_tables(tmp_path)
    assert list(tables) == list(CHANNELS)
    for name, table in recorder.tables().items():
        assert table.names == tables[name].names == tuple(CHANNELS[name])
        np.testing.assert_array_equal(table.times, tables[name].times)
        np.testing.assert_array_equal(table.data, tables[name].data)


def test_a_file_cut_at_any_byte_keeps_all_whole_chunks(tmp_path: Path) -> None:
    """A run killed at any moment: what is there is read, what is whole is never lost, and nothing is made up."""
    write(tmp_path)
    content = (tmp_path / SIGNALS_FILE).read_bytes()
    whole = load_tables(tmp_path)
    ends = sorted(end for end, _, _ in chunks(content))
    cut = tmp_path / "cut"
    cut.mkdir()
    seen = set()
    announced = content.index(b"signals/drives")  # the last thing before the first chunk
    for length in range(len(content) + 1):
        (cut / SIGNALS_FILE).write_bytes(content[:length])
        try:
            tables = load_tables(cut)
        except UserError as error:
            assert length < announced and str(cut) in str(error)
            continue
        for name, table in tables.items():
            expected = sum(rows for end, channel, rows in chunks(content) if end <= length and channel == name)
            assert len(table) == expected, (length, name)
            np.testing.assert_array_equal(table.data, whole[name].data[:expected])
            seen.add((name, expected))
    assert len(ends) == 6 and seen == {(name, rows) for name in CHANNELS for rows in (0, 3, 4, 6)}


def test_a_file_with_any_byte_changed_is_refused_or_read_as_it_was(tmp_path: Path) -> None:
    write(tmp_path)
    file = tmp_path / SIGNALS_FILE
    content, whole = file.read_bytes(), load_tables(tmp_path)
    refused = 0
    for at in range(len(content)):
        file.write_bytes(content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :])
        try:
            tables = load_tables(tmp_path)
        except UserError as error:
            assert str(file) in str(error)
            refused += 1
            continue
        for name, table in whole.items():
            np.testing.assert_array_equal(tables[name].times, table.times)
            np.testing.assert_array_equal(tables[name].data, table.data)
    assert refused >= content.index(b"\x0f", max(end for end, _, _ in chunks(content)))  # all before the data's end


def chunks(content: bytes) -> Iterator[tuple[int, str, int]]:
    """End, channel and rows of every chunk, by walking the records of the data section."""
    at = 8
    while content[at] != 0x0F:  # data end
        length = struct.unpack_from("<Q", content, at + 1)[0]
        if content[at] == 0x06:
            message = at + 9 + 40  # no compression: its name is an empty string
            size, channel = struct.unpack_from("<QH", content, message + 1)
            yield at + 9 + length, list(CHANNELS)[channel - 1], (length - 40) // (size + 9)
        at += 9 + length


def test_everything_flushed_is_with_the_operating_system(tmp_path: Path) -> None:
    """Read by somebody else while the recorder is still open, as after SIGKILL."""
    write(tmp_path, flush_after=(3,), close=False)
    tables = load_tables(tmp_path)
    assert [len(table) for table in tables.values()] == [4, 4]
    frames = [f for bus in BUSES for f in can.CanutilsLogReader(tmp_path / f"{bus}.log")]
    assert [frame.data[0] for frame in frames] == [0, 2, 1, 3] and all(f.is_fd and f.bitrate_switch for f in frames)


@pytest.mark.parametrize("content", [b"", b"not a record at all", b"\x89MCAP0\r\n"])
def test_a_directory_without_a_record_is_named(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        load_tables(tmp_path)
    (tmp_path / SIGNALS_FILE).write_bytes(content)
    with pytest.raises(UserError, match=r"not an MCAP file|holds no record"):
        load_tables(tmp_path)


@given(st.sets(st.integers(0, 5)))
def test_the_digest_does_not_depend_on_where_flushes_were(flushes: set[int]) -> None:
    assert write(None, tuple(flushes)).digest() == write(None, ()).digest()


def test_writing_to_a_directory_does_not_change_the_digest(tmp_path: Path) -> None:
    assert write(tmp_path).digest() == write(None).digest()


def test_other_logs_hold_the_same_frames_and_do_not_change_the_digest(tmp_path: Path) -> None:
    """Read by somebody else while the recorder is still open; ``asc`` twice is once."""
    readers = {"log": can.CanutilsLogReader, "asc": can.ASCReader, "blf": can.BLFReader}
    recorder = Recorder(tmp_path, CHANNELS, BUSES, log_formats=("asc", "pcap", "candump", "asc", "blf"))
    plain = Recorder(None, CHANNELS, BUSES)
    for r in (recorder, plain):
        for n in range(300):
            r.frame(n, 0, Frame(0x184, bytes([n % 256] * 64), True, True, False))
        r.frame(300, 0, ErrorFrame(0x88, bytes(8)))
        r.flush(300)
    assert (tmp_path / "left_leg.pcap").stat().st_size == 24 + 300 * (16 + 72) + 16 + 16
    assert len(list(can.CanutilsLogReader(tmp_path / "left_leg.log"))) == 301
    assert len(list(can.ASCReader(tmp_path / "left_leg.asc"))) == 301
    assert len(list(can.BLFReader(tmp_path / "left_leg.blf"))) > 301 - 16 * 1024 / 64
    recorder.close()
    for suffix, reader in readers.items():
        read = list(reader(tmp_path / f"left_leg.{suffix}"))
        assert len(read) == 301 and read[7].data == bytes([7] * 64) and read[300].is_error_frame
    assert recorder.digest() == plain.digest()
    assert {path.name for path in tmp_path.iterdir()} == {
        SIGNALS_FILE, *(f"{bus}.{suffix}" for bus in BUSES for suffix in ("log", "asc", "blf", "pcap"))
    }  # fmt: skip


@given(st.integers(0, 2), st.integers(0, 63), st.sampled_from(["world", "drives", "time", "bus", "frame"]))
def test_the_digest_sees_every_bit(row: int, bit: int, where: str) -> None:
    def record(flip: bool) -> str:
        recorder = Recorder(None, CHANNELS, BUSES)
        for n in range(3):
            flipped = flip and n == row
            time, values, data = 1000 * n, ROWS[n].copy(), bytearray(8)
            if flipped and where in CHANNELS:
                values.view(np.uint64)[0] ^= np.uint64(1 << bit)
            if flipped and where == "frame":
                data[bit // 8] ^= 1 << bit % 8
            recorder.channel("world").append(time ^ (flipped and where == "time") << bit % 32, values)
            recorder.channel("drives").append(time, values[:1])
            recorder.frame(time, int(flipped and where == "bus"), Frame(0x184, bytes(data), True, True, False))
        return recorder.digest()

    assert record(True) != record(False) == record(False)


def test_names_belong_to_the_digest() -> None:
    def empty(channels: dict[str, list[str]], buses: list[str]) -> str:
        return Recorder(None, channels, buses).digest()

    assert len({empty({"a": ["x"]}, ["l"]), empty({"a": ["y"]}, ["l"]), empty({"b": ["x"]}, ["l"]),
                empty({"a": ["x"]}, ["r"]), empty({"a": ["x", "y"]}, ["l"])}) == 5  # fmt: skip


@settings(max_examples=20)
@given(st.lists(st.integers(0, 5000), max_size=5))
def test_taken_parts_are_all_rows_once(counts: list[int]) -> None:
    """Across the edges of blocks."""
    recorder, n, taken = RowRecorder("x", ["a", "b"]), 0, []
    for count in counts:
        for _ in range(count):
            recorder.append(n, np.array([n, -n], float))
            n += 1
        taken += [rows for _, rows in recorder.take()]
    expected = np.arange(n)
    assert np.concatenate([np.empty((0, 2)), *taken])[:, 0].tolist() == expected.tolist()
    table = recorder.table()
    assert len(recorder) == len(table) == n and table.times.tolist() == expected.tolist()


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError):
        RowRecorder("x", ["a", "b"]).append(0, np.zeros(3))


def test_a_closed_recorder_can_be_closed_again(tmp_path: Path) -> None:
    recorder = write(tmp_path)
    size = (tmp_path / SIGNALS_FILE).stat().st_size
    recorder.close()
    assert (tmp_path / SIGNALS_FILE).stat().st_size == size


@pytest.mark.parametrize("signals", [["a.b", "a_b"], ["A"], ["1a"], ["a..b"], ["a-b"], [""]])
def test_names_that_ros_does_not_take_are_refused(signals: list[str]) -> None:
    with pytest.raises(ValueError, match="field name"):
        field_names(signals)


def test_an_empty_record_is_a_valid_file(tmp_path: Path) -> None:
    McapWriter(tmp_path / SIGNALS_FILE, CHANNELS).close()
    summary = make_reader(io.BytesIO((tmp_path / SIGNALS_FILE).read_bytes()), validate_crcs=True).get_summary()
    assert summary is not None and summary.statistics is not None and summary.statistics.message_count == 0
    assert [len(table) for table in load_tables(tmp_path).values()] == [0, 0]


TABLE = Signals(TIMES, ("com.x", "com.z", "q.left_knee"), ROWS)


def test_columns_by_name_and_prefix() -> None:
    assert TABLE["com.z"].tolist() == ROWS[:, 1].tolist()
    assert TABLE.members("com") == ["x", "z"] and TABLE.group("com").tolist() == ROWS[:, :2].tolist()
    assert TABLE.vector("q.left_knee", "com.x").tolist() == ROWS[:, [2, 0]].tolist()
    assert "com.x" in TABLE and "com.y" not in TABLE and TABLE.members("co") == []
    with pytest.raises(UnknownSignalError, match=r"near to it: q\.left_knee"):
        TABLE["q.left_kne"]


@given(st.lists(st.integers(-10, 2**41), min_size=1))
def test_latest_before_is_the_last_row_not_later(times: list[int]) -> None:
    for time, row in zip(times, TABLE.latest_before(np.array(times)), strict=True):
        assert row == max((i for i, t in enumerate(TIMES) if t <= time), default=0)


def test_one_channel_is_loaded_by_its_name(tmp_path: Path) -> None:
    write(tmp_path)
    assert len(Signals.load(tmp_path, "world")) == 6
    with pytest.raises(UserError, match="no channel 'wrld'; there is: world, drives"):
        Signals.load(tmp_path, "wrld")


def test_the_message_index_points_at_the_messages(tmp_path: Path) -> None:
    """Viewers that seek rely on it; the reader for Python does not."""
    write(tmp_path)
    content = b""
    indexed = 0
    with (tmp_path / SIGNALS_FILE).open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                content = record.data
            elif isinstance(record, MessageIndex):
                for time, offset in record.records:
                    opcode, _, channel, _, log_time = struct.unpack_from("<BQHIQ", content, offset)
                    assert (opcode, channel, log_time) == (0x05, record.channel_id, time)
                    indexed += 1
    assert indexed == 12
