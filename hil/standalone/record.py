"""What a stand-alone bus writes: a candump log of its frames, and a text of what happened to it."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TextIO

from bus.candump import format_line
from bus.frames import ErrorFrame, Frame

LARGEST = 256 << 20  # bytes of a log; then a new one begins, and the one before the last is dropped
_FRAMES, _EVENTS = "frames.log", "events.log"


class Record:
    """Two files in ``directory``. A log that was there before becomes ``frames.log.1``.

    A disk that takes no more ends the record, not the bus: ``failure`` says so.
    """

    def __init__(self, directory: Path, bus: str, largest: int = LARGEST) -> None:
        self.directory = directory
        self.failure: str | None = None
        self._bus, self._largest = bus, largest
        self._path = directory / _FRAMES
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._events: TextIO = (directory / _EVENTS).open("a", encoding="utf-8")
        self._begin()

    def _begin(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            if self._path.stat().st_size:
                self._path.replace(self._path.with_name(_FRAMES + ".1"))
        self._frames: TextIO = self._path.open("w", encoding="ascii")
        self._size = 0

    def frame(self, time_ns: int, frame: Frame | ErrorFrame) -> None:
        """A frame that the bus delivered at ``time_ns``, or an error frame of one of its nodes."""
        if self.failure is None:
            line = format_line(time_ns, self._bus, frame)
            try:
                self._frames.write(line + "\n")
            except OSError as error:
                self._fail(error)
            self._size += len(line) + 1

    def event(self, time_ns: int, sentence: str) -> None:
        """Something that happened at ``time_ns`` of the bus; with the time of day."""
        day = time.strftime("%Y-%m-%d %H:%M:%S")
        with contextlib.suppress(OSError):
            self._events.write(f"{day} ({time_ns * 1e-9:.9f}) {' '.join(sentence.split())}\n")
            self._events.flush()

    def flush(self) -> None:
        """Hand everything to the operating system: it survives the death of this process from here on."""
        if self.failure is not None:
            return
        try:
            self._frames.flush()
            if self._size >= self._largest:
                self._frames.close()
                self._begin()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = f"{self._path} could not be written ({error.strerror}): the log ends there"

    def close(self) -> None:
        self.flush()
        for file in (self._frames, self._events):
            with contextlib.suppress(OSError):
                file.close()
