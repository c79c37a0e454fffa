"""A sweep along one axis: the share of stable runs over the value, with intervals, and where it crosses one half."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.errors import UserError
from hil.lab.places import Places, crossings, places
from hil.lab.quantity import Quantity, Value
from hil.lab.statistics import CONFIDENCE, Interval, share_interval
from hil.scenario import Scenario


@dataclass(frozen=True)
class Boundary:
    """value: where half of the runs are stable, on a line between the values beside it. low, high: the last values
    before and behind it whose side the seeds tell; None where there is none. rising: whether it is stable above it."""

    value: float
    low: float | None
    high: float | None
    rising: bool


@dataclass(frozen=True)
class StabilityLine:
    """Values (n) in SI units, ascending if they are numbers; stable: runs of each that are; intervals: Clopper and
    Pearson's, 95 %, of its share; decided, confidence, reasons: as of a map. metrics: (value's number, seed's verdict,
    metric) of every run, by name of the metric."""

    scenario: Scenario
    quantity: Quantity
    log: bool
    values: tuple[Value, ...]
    stable: tuple[int, ...]
    runs: tuple[int, ...]
    intervals: tuple[Interval, ...]
    decided: tuple[int, ...]
    confidence: float
    reasons: tuple[str, ...]
    metrics: Mapping[str, tuple[tuple[int, bool, float], ...]]

    @property
    def share(self) -> np.ndarray:
        """Of the runs at each value (n,) that are stable."""
        return np.array(self.stable) / np.array(self.runs)

    @property
    def boundaries(self) -> list[Boundary]:
        """From the lowest to the highest; none of a quantity that is no number."""
        if not self.quantity.numeric:
            return []
        values = [float(value) for value in self.values]
        found = []
        for at, before in crossings(values, self.share.tolist(), self.log):
            rising = bool(self.share[before + 1] >= 0.5)
            below, above = (-1, 1) if rising else (1, -1)
            low = next((values[n] for n in range(before, -1, -1) if self.decided[n] == below), None)
            high = next((values[n] for n in range(before + 1, len(values)) if self.decided[n] == above), None)
            found.append(Boundary(at, low, high, rising))
        return found


def line_places(directory: Path, x: str | None = None, where: Mapping[str, str] | None = None) -> Places:
    """The places of a sweep along ``x`` (default: the axis that ``where`` leaves). Raises UserError."""
    found = places(directory, [] if x is None else [x], where)
    keys = [q.key for q in found.quantities]
    if len(keys) != 1:
        rest = ", ".join(keys[1:]) or "no axis"
        raise UserError(f"{directory}: --where KEY=VALUE has to leave one axis, and hold the others: {rest}")
    return found


def line_of(found: Places) -> StabilityLine:
    """The line of places along one axis."""
    every = list(found.rows)
    verdicts = [list(found.stable(place).values()) for place in every]
    metrics: dict[str, tuple[tuple[int, bool, float], ...]] = {}
    for name, column in found.columns.items():
        if name.startswith("metrics."):
            metrics[name.removeprefix("metrics.")] = tuple(
                (n, found.columns["verdict"][row] == "stable", float(column[row]))
                for n, place in enumerate(every) for row in found.rows[place] if column[row] is not None
            )  # fmt: skip
    return StabilityLine(
        found.scenario, found.quantities[0], found.logs[0], tuple(place[0] for place in every),
        tuple(sum(v) for v in verdicts), tuple(len(v) for v in verdicts),
        tuple(share_interval(sum(v), len(v), CONFIDENCE) for v in verdicts),
        tuple(found.decided(place) for place in every), found.confidence,
        tuple(found.reason(place) for place in every), metrics,
    )  # fmt: skip
