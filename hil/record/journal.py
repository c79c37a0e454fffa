"""The journal of a run: what it started from and what came into it from outside, so that it can be replayed.

``journal.jsonl`` holds one JSON object per line, each in the hands of the operating system as soon as it is written:

- first ``{"run": …}``: scenario, seed, clock and versions;
- ``{"time_ns": …, "key": …, "value": …, "by": …}``: an injection, by "scenario" or "query";
- ``{"time_ns": …, "bus": …, "port": …, "frame": …}``: a frame that an attached tool handed to a bus;
- ``{"time_ns": …, "digest": …}``: the digest of the record, complete up to this time, about every 0.1 s;
- last, unless the run was killed, ``{"end_ns": …, "digest": …}``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TextIO

from bus.frames import Frame, InvalidFrameError, checked
from hil.errors import UserError

JOURNAL_FILE = "journal.jsonl"


class Journal:
    """Writes the journal of the run in ``directory``; without one, nothing."""

    def __init__(self, directory: Path | None) -> None:
        self._file: TextIO | None = None
        if directory is not None:
            directory.mkdir(parents=True, exist_ok=True)
            self._file = (directory / JOURNAL_FILE).open("w", encoding="utf-8")

    @property
    def is_open(self) -> bool:
        return self._file is not None

    def write(self, entry: dict[str, Any]) -> None:
        """Append one entry; it survives the death of this process."""
        if self._file is not None:
            self._file.write(json.dumps(entry) + "\n")
            self._file.flush()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


class Digests(Journal):
    """Keeps the digests of a replay by their time, to be compared; writes the journal, too, if it has a directory."""

    def __init__(self, directory: Path | None = None) -> None:
        super().__init__(directory)
        self.at: dict[int, str] = {}

    @property
    def is_open(self) -> bool:
        return True

    def write(self, entry: dict[str, Any]) -> None:
        super().write(entry)
        if "digest" in entry and "time_ns" in entry:
            self.at[entry["time_ns"]] = entry["digest"]


class Entries(Journal):
    """Keeps a run's entries in memory."""

    def __init__(self) -> None:
        super().__init__(None)
        self.entries: list[dict[str, Any]] = []

    @property
    def is_open(self) -> bool:
        return True

    def write(self, entry: dict[str, Any]) -> None:
        self.entries.append(entry)


def frame_entry(time_ns: int, bus: str, port: int, frame: Frame) -> dict[str, Any]:
    """The entry of a frame that a tool sent."""
    return {"time_ns": time_ns, "bus": bus, "port": port, "frame": {**frame._asdict(), "data": frame.data.hex()}}


def frame_of(entry: dict[str, Any]) -> Frame:
    """The frame of such an entry. Raises ValueError (InvalidFrameError included), KeyError or TypeError."""
    content = dict(entry["frame"])
    return checked(Frame(**{**content, "data": bytes.fromhex(content["data"])}))


def read(directory: Path) -> list[dict[str, Any]]:
    """The entries of the journal in ``directory``. A last line that was cut off is left out.

    Raises UserError for anything that is no journal.
    """
    path = directory / JOURNAL_FILE
    try:
        text = path.read_bytes().decode("utf-8", "replace")
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    lines = text.split("\n")[:-1]  # what follows the last newline was not written to its end
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            entry = json.loads(line)
            _check(entry, first=number == 1)
        except (ValueError, KeyError, TypeError, RecursionError, InvalidFrameError):
            raise UserError(f"{path}: line {number} is not of a run's journal") from None
        entries.append(entry)
    if not entries:
        raise UserError(f"{path}: holds nothing; the run was ended before it began")
    return entries


def _check(entry: dict[str, Any], first: bool) -> None:
    """Raises KeyError, TypeError or ValueError for what is no entry."""
    if first:
        run = entry["run"]
        if not isinstance(run["configuration"], dict) or type(run["seed"]) is not int:
            raise ValueError
        return
    time = entry["end_ns" if "end_ns" in entry else "time_ns"]
    if type(time) is not int or time < 0:
        raise ValueError
    if "digest" in entry:
        valid = isinstance(entry["digest"], str)
    elif "frame" in entry:
        frame_of(entry)
        valid = isinstance(entry["bus"], str) and type(entry["port"]) is int
    else:
        valid = isinstance(entry["key"], str) and entry["by"] in ("scenario", "query")
    if not valid:
        raise ValueError
