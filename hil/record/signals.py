"""Recorded signals: one table per channel, rows in time, named columns; read back from a run directory."""

from __future__ import annotations

import difflib
import mmap
import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from hil.errors import UserError

SIGNALS_FILE = "signals.mcap"


class UnknownSignalError(KeyError):
    """No signal of that name in the table."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class Signals:
    """A channel's record.

    times: (n,) int64, ns of the run's time, ascending. names: m signals. data: (n, m) float64.
    """

    times: np.ndarray
    names: tuple[str, ...]
    data: np.ndarray

    @cached_property
    def _column(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def seconds(self) -> np.ndarray:
        """Times in seconds, (n,)."""
        return self.times * 1e-9

    def __len__(self) -> int:
        return len(self.times)

    def __contains__(self, name: object) -> bool:
        return name in self._column

    def __getitem__(self, name: str) -> np.ndarray:
        """View of one column, (n,). Raises UnknownSignalError with the nearest name."""
        return self.data[:, self.index(name)]

    def index(self, name: str) -> int:
        """Column of a signal. Raises UnknownSignalError with the nearest name."""
        try:
            return self._column[name]
        except KeyError:
            close = difflib.get_close_matches(name, self.names, n=3, cutoff=0.4) or self.names[:8]
            raise UnknownSignalError(f"no signal {name!r}; near to it: {', '.join(close)}") from None

    def vector(self, *names: str) -> np.ndarray:
        """Several columns side by side, (n, len(names)), copied."""
        return self.data[:, [self.index(name) for name in names]]

    def members(self, prefix: str) -> list[str]:
        """What follows ``prefix.`` in the names, in the table's order: the joints of ``q``, the buses of ``load``."""
        return [name[len(prefix) + 1 :] for name in self.names if name.startswith(prefix + ".")]

    def group(self, prefix: str) -> np.ndarray:
        """All columns ``prefix.*``, (n, k), copied."""
        return self.vector(*(f"{prefix}.{member}" for member in self.members(prefix)))

    def latest_before(self, times: np.ndarray) -> np.ndarray:
        """For each of ``times`` (ns) the index of the last row at or before it, (k,); the first row if none is."""
        return np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)

    @classmethod
    def load(cls, path: str | Path, channel: str, file: str = SIGNALS_FILE) -> Self:
        """One channel of the run in directory ``path``, from this of its files; what a killed run had written is read
        without complaint.

        Raises UserError if there is no such run or channel.
        """
        tables = load_tables(path, file)
        if channel not in tables:
            raise UserError(f"{path}: no channel {channel!r}; there is: {', '.join(tables)}")
        table = tables[channel]
        return cls(table.times, table.names, table.data)


def load_tables(path: str | Path, name: str = SIGNALS_FILE) -> dict[str, Signals]:
    """All channels of the run in directory ``path``, by name; of a run that was killed, what it had written.

    Raises UserError if there is no record in it, or one that is damaged: its checksums are looked at.
    """
    from mcap.exceptions import InvalidMagic, McapError
    from mcap.records import Channel, Chunk, DataEnd
    from mcap.stream_reader import StreamReader
    from mcap.writer import MCAP0_MAGIC

    from hil.record.mcap_writer import FIELDS_KEY, message_type

    file = Path(path) / name
    names: dict[int, tuple[str, tuple[str, ...]]] = {}
    parts: dict[int, list[np.ndarray]] = {}

    def read_chunk(chunk: Chunk) -> None:
        content = chunk.data
        if chunk.compression or zlib.crc32(content) != chunk.uncompressed_crc:
            raise ValueError("a chunk's checksum is wrong")
        channel = int.from_bytes(content[9:11], "little")  # of the first message; a chunk holds one channel
        parts[channel].append(np.frombuffer(content, message_type(len(names[channel][1]))))

    try:
        with file.open("rb") as source:
            if not os.fstat(source.fileno()).st_size:
                raise UserError(f"{file}: not an MCAP file")
            # mapped, because a length in a damaged file must not make us allocate it
            with mmap.mmap(source.fileno(), 0, access=mmap.ACCESS_READ) as content:
                try:
                    for record in StreamReader(content, emit_chunks=True, validate_crcs=True).records:  # type: ignore[arg-type]
                        if isinstance(record, Channel) and record.id not in names:
                            signals = tuple(record.metadata[FIELDS_KEY].split(" "))
                            names[record.id] = record.topic.removeprefix("/"), signals
                            parts[record.id] = []
                        elif isinstance(record, Chunk):
                            read_chunk(record)
                        elif isinstance(record, DataEnd):
                            break  # what follows repeats the channels, without a checksum
                except (McapError, struct.error, ValueError, KeyError, OverflowError) as error:
                    if isinstance(error, InvalidMagic) and not names:
                        raise UserError(f"{file}: not an MCAP file") from None
                    complete = len(content) > len(MCAP0_MAGIC) and content[-len(MCAP0_MAGIC) :] == MCAP0_MAGIC
                    if content.tell() < len(content) or complete:
                        raise UserError(f"{file}: damaged before byte {content.tell()}") from None
                    # else cut off where the run was killed
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror})") from None
    if not names:
        raise UserError(f"{file}: holds no record; the run was ended before it began to write")
    return {name: _table(signals, parts[channel]) for channel, (name, signals) in names.items()}


def _table(names: Sequence[str], parts: Sequence[np.ndarray]) -> Signals:
    if not parts:
        return Signals(np.empty(0, np.int64), tuple(names), np.empty((0, len(names))))
    times = np.concatenate([part["log_time"] for part in parts]).astype(np.int64)
    return Signals(times, tuple(names), np.concatenate([part["row"] for part in parts]))
