"""The places of a sweep: points of its axes with all their runs, some axes held, as maps and pages draw them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import UserError
from hil.lab.kept import Pair
from hil.lab.quantity import Quantity, Value, quantity
from hil.lab.statistics import CONFIDENCE, share_interval
from hil.lab.sweep import read_table
from hil.scenario import Scenario, complete, to_toml

Place = tuple[Value, ...]


@dataclass(frozen=True)
class Places:
    """scenario: of the sweep. at: when injectable values change, s. quantities, logs: of the axes that are free, in the
    order in which they are wanted. held: the others, by quantity. rows: numbers of the table's rows by place, in order
    of the last axis, then the one before. grid: whether it is a grid rather than samples."""

    directory: Path
    scenario: Scenario
    at: float
    quantities: tuple[Quantity, ...]
    logs: tuple[bool, ...]
    held: Mapping[Quantity, Value]
    columns: Mapping[str, Sequence[Any]]
    rows: Mapping[Place, Sequence[int]]
    grid: bool

    def stable(self, place: Place) -> dict[int, bool]:
        """Whether it was stable, by seed."""
        return {self.columns["seed"][row]: self.columns["verdict"][row] == "stable" for row in self.rows[place]}

    def reason(self, place: Place) -> str:
        """The most frequent one."""
        of_place = [self.columns["reason"][row] for row in self.rows[place]]
        return max(dict.fromkeys(of_place), key=of_place.count)

    def came_first(self, place: Place) -> list[str]:
        """The first sign of each run that failed, as far as the table tells."""
        known = self.columns.get("came_first", [None] * len(self.columns["reason"]))
        return [known[row] for row in self.rows[place] if known[row]]

    def share(self, place: Place) -> float:
        """Of its runs that are stable."""
        verdicts = self.stable(place).values()
        return sum(verdicts) / len(verdicts)

    @cached_property
    def confidence(self) -> float:
        """With which a place is decided: 95 % or, of fewer than six seeds, what unanimous ones can give."""
        most = max(len(rows) for rows in self.rows.values())
        return min(CONFIDENCE, 1.0 - 2.0 ** (1 - most))

    def decided(self, place: Place) -> int:
        """1: stable, −1: not, 0: its seeds do not tell."""
        verdicts = self.stable(place).values()
        if self.confidence <= 0:
            return 0
        low, high, _ = share_interval(sum(verdicts), len(verdicts), self.confidence)
        return 1 if low >= 0.5 - 1e-9 else -1 if high <= 0.5 + 1e-9 else 0

    def pair(self) -> Pair | None:
        """Two places next to each other, and a seed that is stable at the one and not at the other: of those that are
        nearest to each other the nearest to the scenario's own values. None if there are none."""
        unit = {place: self._unit(place) for place in self.rows}
        home = self._unit(tuple(q.nominal for q in self.quantities))
        best: tuple[float, float] | None = None
        found = None
        for a in self.rows:
            if self.share(a) < 0.5:
                continue
            for b in self.rows:
                if self.share(b) >= 0.5:
                    continue
                here, there = self.stable(a), self.stable(b)
                seed = next((s for s in here if here[s] and not there.get(s, True)), None)
                apart = round(float(np.abs(unit[a] - unit[b]).sum()), 9)
                far = float(np.linalg.norm(0.5 * (unit[a] + unit[b]) - home))
                if seed is not None and (best is None or (apart, far) < best):
                    best = apart, far
                    found = Pair(seed, self._values(a), self._values(b))
        return found

    def _values(self, place: Place) -> dict[Quantity, Value]:
        return {**self.held, **dict(zip(self.quantities, place, strict=True))}

    def _unit(self, place: Place) -> np.ndarray:
        """Where a place is, from 0 to 1 along each axis; of one that is no number the position in its list."""
        result = []
        for n, (q, log, value) in enumerate(zip(self.quantities, self.logs, place, strict=True)):
            every = list(dict.fromkeys(p[n] for p in self.rows))
            if not q.numeric:
                every = sorted(map(str, every))
                result.append(every.index(str(value)) / len(every) if str(value) in every else 0.0)
                continue
            values = np.array([*every, value], float)
            values = np.log(np.maximum(values, 1e-30)) if log else values
            span = float(np.ptp(values[:-1])) or 1.0
            result.append(float(values[-1] - values[:-1].min()) / span)
        return np.array(result)


def places(directory: Path, wanted: Sequence[str] = (), where: Mapping[str, str] | None = None) -> Places:
    """The places of the sweep in ``directory``: ``wanted`` axes first, ``where`` (values by key, as written) holds
    others. Raises UserError."""
    columns, manifest = read_table(directory)
    scenario = complete(_readable(manifest["scenario"]), str(directory))
    axes = {a["key"]: a for a in manifest["axes"]}
    where = where or {}
    for key in (*where, *wanted):
        if key not in axes:
            raise UserError(f"{key} is not varied in {directory}; there are {', '.join(axes)}")
    for key in wanted:
        if key in where:
            raise UserError(f"{key}: drawn over, or held with --where, not both")
    free = [*wanted, *(key for key in axes if key not in where and key not in wanted)]
    chosen = np.ones(len(columns["point"]), bool)
    held: dict[Quantity, Value] = {}
    for key, text in where.items():
        value = quantity(scenario, key).parse(text)
        match = np.array([_same(value, entry) for entry in columns[key]])
        if not match.any():
            there = ", ".join(quantity(scenario, key).shown(entry) for entry in dict.fromkeys(columns[key]))
            raise UserError(f"--where {key}={text}: not swept; there are {there}")
        chosen &= match
        held[quantity(scenario, key)] = value
    rows: dict[Place, list[int]] = {}
    for row in np.flatnonzero(chosen):
        rows.setdefault(tuple(columns[key][row] for key in free), []).append(int(row))
    numeric = all(quantity(scenario, key).numeric for key in free)
    ordered = sorted(rows, key=lambda place: place[::-1]) if numeric else list(rows)
    return Places(
        directory, scenario, float(manifest["at"]), tuple(quantity(scenario, key) for key in free),
        tuple(axes[key]["log"] for key in free), held, columns, {place: rows[place] for place in ordered},
        manifest["sample"] is None,
    )  # fmt: skip


def crossings(values: Sequence[float], share: Sequence[float], log: bool = False) -> list[tuple[float, int]]:
    """Where ``share`` crosses ½, from one of ``values`` (ascending) to the next, on a line between the two (of equal
    ratios if ``log``); each with the index of the value before it."""
    v = np.log(np.asarray(values, float)) if log else np.asarray(values, float)
    found = []
    for n in range(len(v) - 1):
        a, b = share[n] - 0.5, share[n + 1] - 0.5
        if (a >= 0) != (b >= 0):
            at = v[n] + (v[n + 1] - v[n]) * a / (a - b)
            found.append((float(np.exp(at)) if log else float(at), n))
    return found


def _same(a: Any, b: Any) -> bool:
    return bool(np.isclose(a, b, rtol=1e-9, atol=0)) if isinstance(a, float) else a == b


def _readable(configuration: dict[str, Any]) -> dict[str, Any]:
    """A dumped configuration as a scenario file holds it."""
    return tomllib.loads(to_toml(json.loads(json.dumps(configuration))))
