"""Two-axis maps from a sweep's table: where it is stable, where it is not, and where its seeds cannot tell.

A place is decided when the interval of Clopper and Pearson for its share of stable runs lies on one side of ½, with a
confidence of 95 % or, of fewer than six seeds, what unanimous seeds can give: 1 − 2^(1−n). The boundary's confidence
band reaches from the last place that is decided on one side to the first one on the other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import UserError
from hil.lab.quantity import Quantity, quantity
from hil.lab.statistics import CONFIDENCE, share_interval
from hil.lab.sweep import read_table
from hil.scenario import complete


@dataclass(frozen=True)
class StabilityMap:
    """Places (n,) by ``x`` and ``y`` in SI units; share of stable runs; decided: 1 stable, −1 not, 0 in doubt.

    shape: rows and columns of a grid, whose places follow each other with x fastest; None for scattered samples.
    reasons: the most frequent one of each place.
    """

    scenario: str
    x_quantity: Quantity
    y_quantity: Quantity
    x_log: bool
    y_log: bool
    x: np.ndarray
    y: np.ndarray
    share: np.ndarray
    runs: np.ndarray
    decided: np.ndarray
    confidence: float
    reasons: tuple[str, ...]
    shape: tuple[int, int] | None

    @property
    def nominal(self) -> tuple[float, float]:
        """The scenario's own values: the operating point of its source."""
        return float(self.x_quantity.nominal), float(self.y_quantity.nominal)


def load_map(
    directory: Path, x: str | None = None, y: str | None = None, where: Mapping[str, str] | None = None
) -> StabilityMap:
    """The map of the sweep in ``directory``.

    Of more than two axes ``x`` and ``y`` say which; ``where`` (values by key, as written) holds the others. Raises
    UserError.
    """
    columns, manifest = read_table(directory)
    scenario = complete(_readable(manifest["scenario"]), str(directory))
    axes = {a["key"]: a for a in manifest["axes"]}
    keys = list(axes)
    if len(keys) < 2:
        raise UserError(f"{directory}: a map needs two axes; this sweep varies {keys[0]} alone")
    where = where or {}
    for key in (*where, *(k for k in (x, y) if k is not None)):
        if key not in axes:
            raise UserError(f"{key} is not varied in {directory}; there are {', '.join(keys)}")
    free = [key for key in keys if key not in where]
    x = x or next(key for key in free if key != y)
    y = y or next((key for key in free if key != x), x)
    held = [key for key in free if key not in (x, y)]
    if x == y or held:
        names = ", ".join(held) or "two axes"
        raise UserError(f"{directory}: --where KEY=VALUE has to leave two axes, and hold the others: {names}")
    qx, qy = quantity(scenario, x), quantity(scenario, y)
    for q in (qx, qy):
        if not q.numeric:
            raise UserError(f"{q.key} has no scale to draw a map over; --x and --y name two that have")
    chosen = np.ones(len(columns["point"]), bool)
    for key, text in where.items():
        value = quantity(scenario, key).parse(text)
        match = np.array([_same(value, entry) for entry in columns[key]])
        if not match.any():
            there = ", ".join(quantity(scenario, key).shown(entry) for entry in dict.fromkeys(columns[key]))
            raise UserError(f"--where {key}={text}: not swept; there are {there}")
        chosen &= match
    return _map(columns, chosen, manifest, (qx, qy), (axes[x]["log"], axes[y]["log"]))


def _map(
    columns: dict[str, list[Any]], chosen: np.ndarray, manifest: dict[str, Any], quantities: tuple[Quantity, Quantity],
    logs: tuple[bool, bool],
) -> StabilityMap:  # fmt: skip
    qx, qy = quantities
    rows = np.flatnonzero(chosen)
    places: dict[tuple[float, float], list[int]] = {}
    for row in rows:
        places.setdefault((float(columns[qy.key][row]), float(columns[qx.key][row])), []).append(int(row))
    ordered = sorted(places)
    stable = [sum(columns["verdict"][row] == "stable" for row in places[place]) for place in ordered]
    runs = [len(places[place]) for place in ordered]
    confidence = min(CONFIDENCE, 1.0 - 2.0 ** (1 - max(runs)))
    decided = [_side(count, n, confidence) for count, n in zip(stable, runs, strict=True)]
    y, x = (np.array(values) for values in zip(*ordered, strict=True))
    shape = (len(set(y)), len(set(x)))
    reasons = []
    for place in ordered:
        of_place = [columns["reason"][row] for row in places[place]]
        reasons.append(max(dict.fromkeys(of_place), key=of_place.count))
    grid = manifest["sample"] is None and shape[0] * shape[1] == len(ordered)
    return StabilityMap(
        manifest["scenario"]["name"], qx, qy, *logs, x, y, np.array(stable) / np.array(runs), np.array(runs),
        np.array(decided), confidence, tuple(reasons), shape if grid else None,
    )  # fmt: skip


def _side(count: int, n: int, confidence: float) -> int:
    low, high, _ = share_interval(count, n, confidence) if confidence > 0 else (0.0, 1.0, 0.0)
    return 1 if low >= 0.5 - 1e-9 else -1 if high <= 0.5 + 1e-9 else 0


def _same(a: Any, b: Any) -> bool:
    return bool(np.isclose(a, b, rtol=1e-9, atol=0)) if isinstance(a, float) else a == b


def _readable(configuration: dict[str, Any]) -> dict[str, Any]:
    """A dumped configuration as a scenario file holds it."""
    import tomllib

    from hil.scenario import to_toml

    return tomllib.loads(to_toml(json.loads(json.dumps(configuration))))
