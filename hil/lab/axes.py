"""The axes of a sweep, and the points that it visits: a grid, or samples of the box that the axes span."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from hil.errors import UserError
from hil.lab.quantity import Quantity, Value, quantity
from hil.scenario import Scenario

_MOST = 100_000  # values of one axis, points of a sample


@dataclass(frozen=True)
class Axis:
    """A quantity and its values, in SI units; of one to be sampled only its ends."""

    quantity: Quantity
    values: tuple[Value, ...]
    log: bool = False

    def at(self, share: float) -> Value:
        """The value at ``share`` (0 to 1) of the way between the ends."""
        low, high = float(self.values[0]), float(self.values[-1])
        value = low * (high / low) ** share if self.log else low + share * (high - low)
        return round(value) if self.quantity.kind == "integer" else short(value)


def short(value: float) -> float:
    """Without the last digits, which are rounding: 0.0003, not 0.00030000000000000003."""
    return float(f"{value:.12g}")


def axis(scenario: Scenario, text: str, sampled: bool = False) -> Axis:
    """Read ``KEY=LOW..HIGH:COUNT[:log]`` or ``KEY=VALUE,VALUE,…``; to be sampled ``KEY=LOW..HIGH[:log]``.

    Raises UserError.
    """
    where = f"--vary {text}"
    key, equals, rest = text.partition("=")
    form = "KEY=LOW..HIGH[:log] with --sample" if sampled else "KEY=LOW..HIGH:COUNT[:log] or KEY=VALUE,VALUE,…"
    if not equals or not key or not rest:
        raise UserError(f"{where}: expected {form}")
    varied = quantity(scenario, key)
    if ".." not in rest:
        if sampled:
            raise UserError(f"{where}: expected {form}")
        values = [varied.parse(part.strip()) for part in rest.split(",")]
        if len(set(values)) < len(values):
            raise UserError(f"{where}: a value is listed twice")
        return Axis(varied, tuple(values))
    ends, *options = rest.split(":")
    log = options[-1:] == ["log"]
    counts = options[:-1] if log else options
    if len(counts) != (0 if sampled else 1):
        raise UserError(f"{where}: expected {form}")
    if not varied.numeric:
        raise UserError(f"{where}: {key} is no number, list its values")
    low, high = (float(varied.parse(end)) for end in ends.split("..", 1))
    if not low < high:
        raise UserError(f"{where}: expected the lower end first, and another than the higher")
    if log and low <= 0:
        raise UserError(f"{where}: a logarithmic axis begins above 0")
    if sampled:
        return Axis(varied, (low, high), log)
    if not counts[0].isascii() or not counts[0].isdigit() or not 2 <= int(counts[0]) <= _MOST:
        raise UserError(f"{where}: expected 2 or more as the number of values")
    spread = np.geomspace(low, high, int(counts[0])) if log else np.linspace(low, high, int(counts[0]))
    whole = varied.kind == "integer"
    values = list(dict.fromkeys(round(v) if whole else short(v) for v in spread.tolist()))
    return Axis(varied, tuple(values), log)


def points(axes: Sequence[Axis], sample: str | None = None) -> list[tuple[Value, ...]]:
    """What a sweep visits: all combinations of the axes' values, the last axis fastest, or ``lhs:N`` or ``sobol:N``
    samples between their ends, the same ones every time. Raises UserError."""
    keys = [a.quantity.key for a in axes]
    for key in keys:
        if keys.count(key) > 1:
            raise UserError(f"--vary {key}: given twice")
    if sample is None:
        count = math.prod(len(a.values) for a in axes)
        if count > _MOST:
            raise UserError(f"--vary: {count} points are more than {_MOST}; --sample takes fewer of them")
        return list(itertools.product(*(a.values for a in axes)))
    unit = _samples(sample, len(axes))
    return [tuple(a.at(share) for a, share in zip(axes, row, strict=True)) for row in unit.tolist()]


def _samples(sample: str, dimensions: int) -> np.ndarray:
    kind, _, text = sample.partition(":")
    if kind not in ("lhs", "sobol") or not text.isascii() or not text.isdigit() or not 1 <= int(text) <= _MOST:
        raise UserError(f"--sample {sample}: expected lhs:N or sobol:N, for example lhs:200")
    count = int(text)
    if kind == "lhs":
        return qmc.LatinHypercube(dimensions, rng=np.random.default_rng(0)).random(count)
    if count & (count - 1):
        raise UserError(f"--sample {sample}: Sobol's points are balanced in powers of two, for example sobol:256")
    return qmc.Sobol(dimensions, rng=np.random.default_rng(0)).random(count)


def written(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """For JSON."""
    return [
        {"key": a.quantity.key, "unit": a.quantity.unit, "nominal": a.quantity.nominal, "values": list(a.values),
         "log": a.log, "injected": a.quantity.injectable}
        for a in axes
    ]  # fmt: skip
