"""Several recorded runs side by side: what differs in their configurations, and their numbers with the differences."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hil.analysis.difference import Comparison, compare
from hil.analysis.numbers import Number, key_numbers
from hil.errors import UserError
from hil.record.recorded import Recorded, read_run
from hil.scenario import to_toml

_NAMES = ("name", "description")  # which change nothing
_LONG = re.compile(r"\d*\.\d+(?:e[-+]?\d+)?")
_LABELLED = 3  # most differing keys that fit into a legend


@dataclass(frozen=True)
class NumberRow:
    """One number of all runs; None where a run has none."""

    name: str
    unit: str
    numbers: tuple[Number | None, ...]

    @property
    def values(self) -> list[float | None]:
        """In ``unit``."""
        return [None if n is None or n.value is None else n.value * n.scale for n in self.numbers]

    @property
    def differences(self) -> list[float | None]:
        """Of each value to that of the first run, in ``unit``."""
        first, *_ = self.values
        return [None if v is None or first is None else v - first for v in self.values]


@dataclass(frozen=True)
class SideBySide:
    """runs, named A, B, …; differing: keys of their configurations that are not equal in all, with the value of each
    as written, None where it has none."""

    runs: tuple[Recorded, ...]
    differing: dict[str, tuple[str | None, ...]]
    rows: tuple[NumberRow, ...]

    @property
    def letters(self) -> list[str]:
        return [letter(n) for n in range(len(self.runs))]

    def label(self, index: int) -> str:
        """What a legend calls a run: its letter, and what is its own."""
        own = [f"{key} = {values[index] or 'nothing'}" for key, values in self.differing.items()]
        text = ", ".join(own) if 0 < len(own) <= _LABELLED else self.runs[index].directory.name
        text = text if len(text) <= 60 else f"{text[:59]}…"
        return f"{letter(index)}: {text}"

    @cached_property
    def parting(self) -> Comparison | None:
        """Of two runs of one robot where they part, to the bit; of others None."""
        if len(self.runs) != 2 or len({run.scenario.robot for run in self.runs}) > 1:
            return None
        a, b = self.runs
        return compare(a.directory, b.directory)

    def record(self) -> dict[str, Any]:
        """For JSON; numbers in the unit that stands beside them."""
        first = None if self.parting is None else self.parting.first
        return {
            "runs": [
                {"name": name, "directory": str(run.directory), "scenario": run.scenario.name, "seed": run.seed,
                 "verdict": run.verdict, "reason": run.reason, "simulated_time": run.end}
                for name, run in zip(self.letters, self.runs, strict=True)
            ],
            "differing": {key: list(values) for key, values in self.differing.items()},
            "first_difference": None if first is None else {"time_s": first.time_ns * 1e-9, **asdict(first)},
            "numbers": {
                row.name: {"unit": row.unit, "values": row.values, "differences": row.differences} for row in self.rows
            },
        }  # fmt: skip


def letter(index: int) -> str:
    """A, B, … Z, A1, B1, …"""
    turn, place = divmod(index, 26)
    return f"{chr(ord('A') + place)}{turn or ''}"


def side_by_side(directories: Sequence[Path]) -> SideBySide:
    """The runs recorded in ``directories``, two or more. Raises UserError."""
    if len(directories) < 2:
        raise UserError("a comparison needs two runs or more")
    places = [directory.resolve() for directory in directories]
    for directory, place in zip(directories, places, strict=True):
        if places.count(place) > 1:
            raise UserError(f"{directory}: given twice")
    runs = tuple(read_run(directory) for directory in directories)
    return SideBySide(runs, _differing(runs), tuple(_rows(runs)))


def _differing(runs: Sequence[Recorded]) -> dict[str, tuple[str | None, ...]]:
    every = [_as_lines(run) for run in runs]
    keys = dict.fromkeys(key for lines in every for key in lines)
    values = {key: tuple(lines.get(key) for lines in every) for key in keys}
    return {key: _short(row) for key, row in values.items() if len(set(row)) > 1}


def _short(row: tuple[str | None, ...]) -> tuple[str | None, ...]:
    """With six digits of each number, if that leaves the values as different as they are."""
    short = tuple(v if v is None else _LONG.sub(lambda m: f"{float(m[0]):.6g}", v) for v in row)
    return short if len(set(short)) == len(set(row)) else row


def _as_lines(run: Recorded) -> dict[str, str]:
    """Every value of the configuration by its key, with seed, backend, and what was injected by hand."""
    pairs = (line.partition(" = ") for line in to_toml(run.configuration).splitlines())
    lines = {key: value.strip('"') for key, _, value in pairs if key not in _NAMES}
    lines = {"scenario": run.scenario.name, "seed": str(run.seed)} | lines
    by_hand = [i for i in run.injected if i.get("by") == "query"]
    if by_hand:
        lines["injected by hand"] = ", ".join(f"{i['key']} = {i['value']} at {i['time_s']:.3f} s" for i in by_hand)
    if run.frames:
        lines["frames from outside"] = str(run.frames)
    return lines


def _rows(runs: Sequence[Recorded]) -> list[NumberRow]:
    every = [{n.name: n for n in key_numbers(run.metrics, run.configuration)} for run in runs]
    every = [{"simulated": Number("simulated", run.end, unit="s")} | own for run, own in zip(runs, every, strict=True)]
    names = dict.fromkeys(name for own in every for name in own)
    rows = []
    for name in names:
        numbers = tuple(own.get(name) for own in every)
        unit = next(n.unit for n in numbers if n is not None)
        rows.append(NumberRow(name, unit, numbers))
    return rows
