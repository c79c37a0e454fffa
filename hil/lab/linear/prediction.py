"""Where a quantity makes the linearised loop unstable: its dominant mode followed from a stable value outwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scipy.optimize import brentq

from hil.lab.linear.linearisation import Linearisation, Mode
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.quantity import Quantity

_FINE = 0.01  # of the distance from where the search starts, if no resolution is asked for


@dataclass(frozen=True)
class Step:
    """The loop at one value."""

    value: float
    linearisation: Linearisation

    def record(self) -> dict[str, Any]:
        mode = self.linearisation.dominant
        return {"value": self.value, "growth": mode.growth, "frequency": mode.frequency, "mode": mode.told()}


@dataclass(frozen=True)
class Prediction:
    """value: where the loop becomes unstable, None if it does not up to the end of the search, or is so from the start.
    mode: what grows there. steps: all that was looked at, by value."""

    value: float | None
    mode: Mode | None
    steps: tuple[Step, ...]

    def record(self) -> dict[str, Any]:
        """For JSON, in SI units."""
        return {
            "predicted": self.value,
            "mode": None if self.mode is None else self.mode.record(),
            "path": [step.record() for step in self.steps],
        }


def predict(
    point: OperatingPoint,
    quantity: Quantity,
    start: float,
    step: float,
    bound: float,
    resolution: float | None = None,
    done: Callable[[Step], None] = lambda _: None,
) -> Prediction:
    """Follow ``quantity`` from ``start`` in steps that double, the first ``step``, to ``bound``; where the loop has
    become unstable, the root of the growth of the mode that did is searched within ``resolution``."""
    steps: dict[float, Step] = {}

    def at(value: float) -> Linearisation:
        value = float(quantity.checked(value))
        if value not in steps:
            steps[value] = Step(value, _linearised(point, quantity, value))
            done(steps[value])
        return steps[value].linearisation

    def answer(value: float | None, mode: Mode | None) -> Prediction:
        return Prediction(value, mode, tuple(steps[key] for key in sorted(steps)))

    if at(start).growth >= 0.0:
        return answer(None, at(start).dominant)
    low, distance = start, step
    while True:
        high = start + distance
        ends = abs(high - start) >= abs(bound - start)
        high = bound if ends else high
        if at(high).growth >= 0.0:
            break
        if ends:
            return answer(None, None)
        low, distance = high, 2.0 * distance
    grown = at(high).dominant

    def growth(value: float) -> float:
        """Of the mode that has become unstable; of any other that is."""
        found = at(value)
        return found.growth if found.growth >= 0.0 else found.like(grown).growth

    fine = _FINE * abs(high - start) if resolution is None else resolution
    value = float(brentq(growth, low, high, xtol=0.5 * fine))
    return answer(value, at(value).like(grown))


def _linearised(point: OperatingPoint, quantity: Quantity, value: float) -> Linearisation:
    if quantity.injectable:
        return point.linearise({quantity.key: value})
    with point.elsewhere(quantity, value) as moved:
        return moved.linearise()
