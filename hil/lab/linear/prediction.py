"""Where a quantity makes the linearised loop unstable: its dominant mode followed from a stable value outwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from scipy.optimize import brentq

from hil.lab.linear.linearisation import Linearisation, Mode
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.margin import Search
from hil.lab.quantity import Quantity, Value

_FINENESS = 100  # without a resolution: the distance from the start over this


class Point(Protocol):
    """What can be linearised with a quantity at any value."""

    def with_value(self, quantity: Quantity, value: Value) -> Linearisation: ...


@dataclass(frozen=True)
class Step:
    """The loop at one value."""

    value: float
    linearisation: Linearisation

    def record(self, followed: Mode | None) -> dict[str, Any]:
        """For JSON, with the growth of the mode that is like ``followed``."""
        mode = self.linearisation.dominant
        return {
            "value": self.value,
            "growth": mode.growth,
            "frequency": mode.frequency,
            "mode": mode.told(),
            "followed": None if followed is None else self.linearisation.like(followed).growth,
        }


@dataclass(frozen=True)
class Prediction:
    """value: where the loop becomes unstable, None if it does not up to the end of the search, or is so from the start.
    mode: what grows just beyond it, or from the start. steps: all that was looked at, by value."""

    value: float | None
    mode: Mode | None
    steps: tuple[Step, ...]

    def record(self) -> dict[str, Any]:
        """For JSON, in SI units."""
        return {
            "predicted": self.value,
            "mode": None if self.mode is None else self.mode.record(),
            "path": [step.record(self.mode) for step in self.steps],
        }


def predicted(search: Search, done: Callable[[Mapping[float, Step]], None] = lambda _: None) -> Prediction:
    """The value that bisection of ``search`` would find, if the loop were linear. Raises UserError where the robot does
    not stand on both feet at ``search.at``."""
    with OperatingPoint(search.scenario, search.at) as point:
        return predict(point, search, done)


STICTION = "dry friction holds small oscillations that the linear loop lets grow"
# How a run fails, by how its reason begins.
_KINDS = {
    "foot slipped": "contact lost",
    "a foot was without load": "contact lost",
    "drive in": "a drive's protection",
    "drive silent": "a drive's protection",
}


def parting(
    search: Search, prediction: Prediction, margin: float | None, reasons: Sequence[str], resolution: float = 0.0
) -> str | None:
    """Why ``margin`` and prediction are further apart than a period of the controller, or if it is no time a twentieth:
    one sentence; None if they are not, or not more than ``resolution``. ``reasons``: verdicts of the smallest values
    that were found unstable."""
    if prediction.value is None or margin is None:
        return None
    apart = margin - prediction.value
    near = 1.0 / search.scenario.controller.rate if search.quantity.unit == "s" else 0.05 * abs(prediction.value)
    if abs(apart) <= max(near, resolution):
        return None
    outwards = apart if search.far is None or search.far > search.start else -apart
    told = search.quantity.shown(abs(apart))
    if outwards > 0.0 and search.scenario.world.friction_scale > 0.0:
        return f"{told} beyond the prediction: {STICTION}"
    common = max(set(reasons), key=reasons.count) if reasons else "unknown"
    kind = next((f"{kind}: " for begins, kind in _KINDS.items() if common.startswith(begins)), "")
    side = "beyond" if outwards > 0.0 else "short of"
    return f"{told} {side} the prediction, and not by growth from small deviations: {kind}{common}"


def predict(point: Point, search: Search, done: Callable[[Mapping[float, Step]], None] = lambda _: None) -> Prediction:
    """Follow the quantity of ``search`` from its start, to its far end or in steps that double; where the loop has
    become unstable, search the root of the growth of the mode that did."""
    quantity, start = search.quantity, search.start
    steps: dict[float, Step] = {}

    def at(value: float) -> Linearisation:
        value = float(quantity.checked(value))
        if value not in steps:
            steps[value] = Step(value, point.with_value(quantity, value))
            done(steps)
        return steps[value].linearisation

    def answer(value: float | None, mode: Mode | None) -> Prediction:
        return Prediction(value, mode, tuple(steps[key] for key in sorted(steps)))

    if at(start).growth >= 0.0:
        return answer(None, at(start).dominant)
    low, high = start, start
    for high in search.outwards():
        if at(high).growth >= 0.0:
            break
        low = high
    else:
        return answer(None, None)
    grown = at(high).dominant

    def growth(value: float) -> float:
        """Of the mode that has become unstable; of any other that is."""
        found = at(value)
        return found.growth if found.growth >= 0.0 else found.like(grown).growth

    fine = abs(high - start) / _FINENESS if search.resolution is None else search.resolution
    value = float(brentq(growth, low, high, xtol=0.5 * fine))
    beyond = [step for step in steps.values() if step.linearisation.growth >= 0.0]
    nearest = min(beyond, key=lambda step: abs(step.value - value))
    return answer(value, nearest.linearisation.dominant)
