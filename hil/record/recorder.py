"""Records a run: signals as rows of float64 per channel, CAN frames as candump lines per bus, and their digest."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from bus.candump import format_line
from bus.frames import ErrorFrame, Frame
from bus.logs import Log, open_log
from hil.record.signals import SIGNALS_FILE, Signals

_BLOCK = 2048  # rows

FormatLine = Callable[[int, str, Frame | ErrorFrame], str]


class RowRecorder:
    """Rows of one channel, kept in preallocated blocks."""

    def __init__(self, name: str, signals: Sequence[str]) -> None:
        self.name = name
        self.signals = tuple(signals)
        self._full: list[tuple[np.ndarray, np.ndarray]] = []  # blocks before the current one
        self._taken = 0  # rows handed out by take(), in all
        self._new_block()

    def _new_block(self) -> None:
        self._times = np.empty(_BLOCK, np.int64)
        self._rows = np.empty((_BLOCK, len(self.signals)))
        self._count = 0  # rows in the current block

    def append(self, time_ns: int, row: np.ndarray) -> None:
        """Copy one row, (m,) float64. Raises ValueError if it has another length."""
        i = self._count
        if i == _BLOCK:
            self._full.append((self._times, self._rows))
            self._new_block()
            i = 0
        self._times[i] = time_ns
        self._rows[i] = row
        self._count = i + 1

    def __len__(self) -> int:
        return _BLOCK * len(self._full) + self._count

    def take(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Times and rows appended since the last take, as views of one or more blocks."""
        parts = []
        for b in range(self._taken // _BLOCK, len(self._full)):
            start = max(self._taken - b * _BLOCK, 0)
            times, rows = self._full[b]
            parts.append((times[start:], rows[start:]))
        start = max(self._taken - len(self._full) * _BLOCK, 0)
        parts.append((self._times[start : self._count], self._rows[start : self._count]))
        self._taken = len(self)
        return [part for part in parts if len(part[0])]

    def snapshot(self) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray, int]:
        """All rows so far; full blocks are shared, nothing writes to them any more."""
        return list(self._full), self._times[: self._count].copy(), self._rows[: self._count].copy(), self._taken

    def restore(self, state: tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray, int]) -> None:
        full, times, rows, self._taken = state
        self._full = list(full)
        self._new_block()
        self._count = len(times)
        self._times[: self._count], self._rows[: self._count] = times, rows

    def table(self) -> Signals:
        """All rows so far, copied."""
        blocks = [*self._full, (self._times[: self._count], self._rows[: self._count])]
        return Signals(
            np.concatenate([times for times, _ in blocks]), self.signals, np.concatenate([rows for _, rows in blocks])
        )


class Recorder:
    """The record of one run.

    A run directory gets ``signals.mcap``, one ``BUS.log`` per bus, and the other logs asked for. Everything up to the
    last flush is in the hands of the operating system and survives the death of this process (of BLF all but the last
    16 kB). Rows are also kept in memory (about 2 MB per second of Hume), where the metrics read them.

    Args:
        directory: where to write, created if missing; None: keep rows and digest only.
        channels: signal names by channel name.
        buses: names of the buses, in the order of their indices.
        format_line: one candump line from time (ns), bus name and frame.
        log_formats: further logs of each bus, of ``bus.logs.FORMATS``; candump's is always written.
    """

    def __init__(
        self,
        directory: Path | None,
        channels: Mapping[str, Sequence[str]],
        buses: Sequence[str],
        format_line: FormatLine = format_line,
        log_formats: Sequence[str] = (),
    ) -> None:
        self._format_line = format_line
        self._channels = {name: RowRecorder(name, signals) for name, signals in channels.items()}
        self._buses = tuple(buses)
        self._frames: list[list[tuple[int, Frame | ErrorFrame]]] = [[] for _ in buses]
        # Times and rows lie in separate arrays: a hash for each, so that where blocks end makes no difference.
        self._hashes: dict[str, tuple[Any, Any]] = {
            name: (hashlib.sha256(" ".join(signals).encode()), hashlib.sha256()) for name, signals in channels.items()
        }
        self._bus_hashes = [hashlib.sha256() for _ in buses]
        self._mcap = None
        self._logs: list[BinaryIO] = []
        self._other_logs: list[list[Log]] = [[] for _ in buses]
        self.flushed_ns = 0  # the directory is complete up to here
        if directory is not None:
            from hil.record.mcap_writer import McapWriter

            directory.mkdir(parents=True, exist_ok=True)
            self._mcap = McapWriter(directory / SIGNALS_FILE, channels)
            self._logs = [(directory / f"{bus}.log").open("wb") for bus in buses]
            others = [name for name in dict.fromkeys(log_formats) if name != "candump"]
            self._other_logs = [
                [open_log(name, directory / f"{bus}.{name}", number) for name in others]
                for number, bus in enumerate(buses, start=1)
            ]

    def channel(self, name: str) -> RowRecorder:
        """Where a channel's rows are appended. Raises KeyError for a channel that was not announced."""
        return self._channels[name]

    def frame(self, time_ns: int, bus_index: int, frame: Frame | ErrorFrame) -> None:
        """A frame that a bus delivered, or an error frame. It is formatted at the next flush."""
        self._frames[bus_index].append((time_ns, frame))

    def flush(self, now_ns: int) -> None:
        """Hash what came since the last flush and write it out; ``now_ns`` is the time up to which it is complete."""
        for name, channel in self._channels.items():
            hash_times, hash_rows = self._hashes[name]
            for times, rows in channel.take():
                hash_times.update(times)
                hash_rows.update(rows)
                if self._mcap is not None:
                    self._mcap.write(name, times, rows)
        if self._mcap is not None:
            self._mcap.flush()
        format_line = self._format_line
        for b, (bus, frames) in enumerate(zip(self._buses, self._frames, strict=True)):
            if not frames:
                continue
            text = "".join([format_line(t, bus, f) + "\n" for t, f in frames]).encode()
            self._bus_hashes[b].update(text)
            if self._logs:
                self._logs[b].write(text)
                self._logs[b].flush()
                for other in self._other_logs[b]:
                    other.write(frames)
            frames.clear()
        self.flushed_ns = now_ns

    def digest(self) -> str:
        """SHA-256 (hexadecimal) of all rows and all bus lines so far, the same wherever flushes were."""
        self.flush(self.flushed_ns)
        total = hashlib.sha256()
        for name in sorted(self._channels):
            hash_times, hash_rows = self._hashes[name]
            total.update(name.encode() + b"\0" + hash_times.digest() + hash_rows.digest())
        for name, lines in sorted(zip(self._buses, self._bus_hashes, strict=True), key=lambda item: item[0]):
            total.update(name.encode() + b"\0" + lines.digest())
        return total.hexdigest()

    def table(self, name: str) -> Signals:
        """All rows of a channel so far. Raises KeyError for a channel that was not announced."""
        return self._channels[name].table()

    def tables(self) -> dict[str, Signals]:
        """All channels so far, by name."""
        return {name: channel.table() for name, channel in self._channels.items()}

    def snapshot(self) -> dict[str, Any]:
        """The record so far. Raises ValueError for one that is written to a directory: what is written is written."""
        if self._mcap is not None:
            raise ValueError("only a record that is kept in memory can go back")
        return {
            "channels": {name: channel.snapshot() for name, channel in self._channels.items()},
            "frames": [list(frames) for frames in self._frames],
            "hashes": {name: (times.copy(), rows.copy()) for name, (times, rows) in self._hashes.items()},
            "bus_hashes": [lines.copy() for lines in self._bus_hashes],
            "flushed_ns": self.flushed_ns,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``snapshot``; what came after it is forgotten."""
        for name, channel in self._channels.items():
            channel.restore(state["channels"][name])
        self._frames = [list(frames) for frames in state["frames"]]
        self._hashes = {name: (times.copy(), rows.copy()) for name, (times, rows) in state["hashes"].items()}
        self._bus_hashes = [lines.copy() for lines in state["bus_hashes"]]
        self.flushed_ns = state["flushed_ns"]

    def close(self) -> None:
        """Flush, complete the MCAP file with its summary, and close all files. A second call does nothing."""
        self.flush(self.flushed_ns)
        if self._mcap is not None:
            self._mcap.close()
            self._mcap = None
        for file in self._logs:
            file.close()
        for log in itertools.chain(*self._other_logs):
            log.close()
        self._logs, self._other_logs = [], [[] for _ in self._buses]
