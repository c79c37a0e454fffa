"""Writes rows of named float64 signals as MCAP, whole blocks at a time.

Messages are ROS 2 CDR with a ``ros2msg`` schema of float64 fields, so PlotJuggler, Foxglove and the stock Python
readers open the file as it is. All messages of a channel have one length: a block of them is one NumPy structured
array, built and written without a loop. Every block is a chunk of its own and every schema stands before the first
chunk, so a file that ends early is readable up to its last whole chunk.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

FIELDS_KEY = "signals"  # in a channel's metadata: the signals' names in the order of the schema's fields
_CDR_HEADER = (0, 1, 0, 0)  # little-endian plain CDR; alignment counts from behind it, so the row needs no padding
_HEAD = 9  # opcode and length in front of every record
_CHUNK_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("start", "<u8"), ("end", "<u8"), ("size", "<u8"), ("crc", "<u4"),
     ("compression", "<u4"), ("stored", "<u8")]
)  # fmt: skip
_INDEX_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("size", "<u4")])
_FIELD_NAME = re.compile(r"[a-z](?:_?[a-z0-9])*")  # as ROS 2 demands


@cache
def message_type(columns: int) -> np.dtype:
    """Layout of a whole message record (opcode to payload) of a channel of ``columns`` signals."""
    return np.dtype(
        [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"),
         ("publish_time", "<u8"), ("cdr", "u1", 4), ("row", "<f8", (columns,))]
    )  # fmt: skip


def field_names(signals: Sequence[str]) -> list[str]:
    """ROS 2 field names of signals: dots become underscores. Raises ValueError if two would be the same."""
    fields = [name.replace(".", "_") for name in signals]
    for name, field in zip(signals, fields, strict=True):
        if not _FIELD_NAME.fullmatch(field):
            raise ValueError(f"signal {name!r} does not give a ROS 2 field name")
        if fields.count(field) > 1:
            raise ValueError(f"signal {name!r} gives a field name that another signal has, too: {field}")
    return fields


class McapWriter:
    """An MCAP file of channels whose rows have fixed lengths.

    Args:
        path: file to create.
        channels: signal names by channel name.
    """

    def __init__(self, path: Path, channels: Mapping[str, Sequence[str]]) -> None:
        self._file = path.open("wb")
        self._position = 0
        self._crc = 0  # of all that was written
        self._ids = {name: i for i, name in enumerate(channels, start=1)}
        self._counts = dict.fromkeys(self._ids.values(), 0)
        self._times = [0, 0]
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._metadata_indexes: list[McapRecord] = []
        self._chunk_indexes: list[McapRecord] = []
        self._write(MCAP0_MAGIC)
        self._write(_encode(Header("ros2", "hume-hil")))
        for name, signals in channels.items():
            fields = field_names(signals)
            text = "".join(f"float64 {field}\n" for field in fields)
            type_name = f"hil/msg/{name.title().replace('_', '')}"
            schema = Schema(id=self._ids[name], data=text.encode(), encoding="ros2msg", name=type_name)
            channel = Channel(self._ids[name], f"/{name}", "cdr", {FIELDS_KEY: " ".join(signals)}, schema.id)
            metadata = Metadata(name=f"signals/{name}", metadata=dict(zip(fields, signals, strict=True)))
            self._schemas.append(schema)
            self._channels.append(channel)
            self._write(_encode(schema) + _encode(channel))
            start = self._position
            self._write(_encode(metadata))
            self._metadata_indexes.append(MetadataIndex(start, self._position - start, metadata.name))
        self.flush()

    def write(self, name: str, times: np.ndarray, rows: np.ndarray) -> None:
        """Append rows (n, m) float64 of channel ``name`` with their times (n,), ns, as one chunk."""
        if not len(times):
            return
        channel = self._ids[name]
        kind = message_type(rows.shape[1])
        count = self._counts[channel]
        messages = np.empty(len(times), kind)
        messages["opcode"] = Opcode.MESSAGE
        messages["length"] = kind.itemsize - _HEAD
        messages["channel"] = channel
        messages["sequence"] = np.arange(count, count + len(times))
        messages["log_time"] = messages["publish_time"] = times
        messages["cdr"] = _CDR_HEADER
        messages["row"] = rows
        self._counts[channel] = count + len(times)
        self._write_chunk(channel, messages.tobytes(), np.asarray(times), kind.itemsize)

    def _write_chunk(self, channel: int, content: bytes, times: np.ndarray, stride: int) -> None:
        first, last = int(times.min()), int(times.max())
        head = np.zeros((), _CHUNK_HEAD)
        head["opcode"], head["length"] = Opcode.CHUNK, _CHUNK_HEAD.itemsize - _HEAD + len(content)
        head["start"], head["end"], head["size"] = first, last, len(content)
        head["crc"], head["stored"] = zlib.crc32(content), len(content)
        entries = np.empty((len(times), 2), "<u8")
        entries[:, 0] = times
        entries[:, 1] = np.arange(len(times)) * stride
        index = np.zeros((), _INDEX_HEAD)
        index["opcode"], index["length"] = Opcode.MESSAGE_INDEX, _INDEX_HEAD.itemsize - _HEAD + entries.nbytes
        index["channel"], index["size"] = channel, entries.nbytes

        start = self._position
        self._write(head.tobytes() + content)
        chunk_end = self._position
        self._write(index.tobytes() + entries.tobytes())
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_length=chunk_end - start,
                chunk_start_offset=start,
                compression="",
                compressed_size=len(content),
                message_end_time=last,
                message_index_length=self._position - chunk_end,
                message_index_offsets={channel: chunk_end},
                message_start_time=first,
                uncompressed_size=len(content),
            )
        )
        begin = first if len(self._chunk_indexes) == 1 else min(first, self._times[0])
        self._times = [begin, max(last, self._times[1])]

    def flush(self) -> None:
        """Hand everything to the operating system: it outlives this process."""
        self._file.flush()

    def close(self) -> None:
        """Write the summary and close the file."""
        self._write(_encode(DataEnd(self._crc)))
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={channel: n for channel, n in self._counts.items() if n},
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            message_end_time=self._times[1],
            message_start_time=self._times[0],
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        summary = b""
        offsets = b""
        start = self._position
        for opcode, records in (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ):
            group = b"".join(_encode(record) for record in records)
            if group:
                offsets += _encode(
                    SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(group))
                )
            summary += group
        footer = Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=0)
        crc = zlib.crc32(summary + offsets + _encode(footer)[:-4])  # of all before the checksum itself
        footer = Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=crc)
        self._write(summary + offsets + _encode(footer) + MCAP0_MAGIC)
        self._file.close()

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)


def _encode(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
