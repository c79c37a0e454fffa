"""What a sweep has done so far, on disk: an append-only file of finished cells, beside what the sweep is.

``sweep.json`` says what is swept; a directory with another one is refused. ``cells.jsonl`` has a line per finished
cell, forced to the disk before the next one is counted. A line that a kill has cut off is cut away when the sweep goes
on.
"""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from typing import IO, Any, Self

from hil.errors import UserError

MANIFEST_FILE = "sweep.json"
CELLS_FILE = "cells.jsonl"

Cell = tuple[int, int]  # point, seed


class CellJournal:
    """Opens the directory, created if missing, for the sweep that ``manifest`` describes.

    ``rows``: what is known of each finished cell. Raises UserError for the directory of another sweep, one that is
    being written to, or a damaged one.
    """

    def __init__(self, directory: Path, manifest: dict[str, Any]) -> None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = (directory / CELLS_FILE).open("a+b")
        except OSError as error:
            raise UserError(f"--out {directory}: cannot be written to ({error.strerror})") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # before anything is looked at
            self.rows = self._recover(directory, manifest)
        except BlockingIOError:
            self._file.close()
            raise UserError(f"--out {directory}: another process is sweeping into it") from None
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, cell: Cell, row: dict[str, Any]) -> None:
        """Note a finished cell; on return it is on the disk."""
        self._file.write(json.dumps({"cell": cell, **row}, allow_nan=False).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.rows[cell] = row

    def _recover(self, directory: Path, manifest: dict[str, Any]) -> dict[Cell, dict[str, Any]]:
        path = directory / MANIFEST_FILE
        self._file.seek(0)
        content = self._file.read()
        if path.exists():
            _compare(directory, read_manifest(directory), json.loads(json.dumps(manifest)))
        elif content:
            raise UserError(f"{directory}: has {CELLS_FILE} and no {MANIFEST_FILE}: not the directory of a sweep")
        else:
            if any(entry.name != CELLS_FILE and not entry.name.endswith(".part") for entry in directory.iterdir()):
                raise UserError(f"--out {directory}: is not empty, and holds no sweep that could go on")
            write_durably(path, json.dumps(manifest, indent=1, allow_nan=False).encode())
        complete = content.rfind(b"\n") + 1
        if complete < len(content):
            self._file.truncate(complete)
        return _cells(directory, content[:complete])


def _cells(directory: Path, content: bytes) -> dict[Cell, dict[str, Any]]:
    rows: dict[Cell, dict[str, Any]] = {}
    for number, line in enumerate(content.splitlines(), start=1):
        try:
            row = json.loads(line)
            point, seed = row.pop("cell")
        except (ValueError, TypeError, AttributeError, KeyError):
            raise UserError(f"{directory / CELLS_FILE}: line {number} is damaged") from None
        rows[point, seed] = row
    return rows


def read_manifest(directory: Path) -> dict[str, Any]:
    """What is swept in ``directory``. Raises UserError when nothing is."""
    path = directory / MANIFEST_FILE
    try:
        manifest = json.loads(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}): not the directory of a sweep?") from None
    except ValueError:
        raise UserError(f"{path}: damaged") from None
    if not isinstance(manifest, dict) or "axes" not in manifest:
        raise UserError(f"{path}: not of a sweep")
    return manifest


def _compare(directory: Path, there: dict[str, Any], here: dict[str, Any]) -> None:
    difference = next(_differences(there, here, ""), None)
    if difference is not None:
        raise UserError(f"--out {directory}: holds another sweep: {difference}; name a new directory")


def _differences(there: Any, here: Any, path: str) -> Any:
    if isinstance(there, dict) and isinstance(here, dict):
        for key in [*there, *(k for k in here if k not in there)]:
            if path or key != "machine":  # what is the same on any of them
                yield from _differences(there.get(key), here.get(key), f"{path}.{key}" if path else key)
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        for number, (a, b) in enumerate(zip(there, here, strict=True)):
            yield from _differences(a, b, f"{path}.{number}")
    elif there != here:
        yield f"{path} is {_short(there)} there, {_short(here)} here"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}…"


def write_durably(path: Path, content: bytes) -> None:
    """Write a file that after a kill is there as a whole or not at all."""
    partial = path.with_name(path.name + ".part")
    with partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
