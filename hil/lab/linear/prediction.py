"""Where a quantity makes the linearised loop unstable: its dominant mode followed from a stable value outwards."""

from __future__ import annotations

from collections.abc import Callable
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
    mode: what grows there, or does from the start. steps: all that was looked at, by value."""

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


def predicted(search: Search, done: Callable[[Step], None] = lambda _: None) -> Prediction:
    """The value that bisection of ``search`` would find, if the loop were linear. Raises UserError where the robot does
    not stand on both feet at ``search.at``."""
    with OperatingPoint(search.scenario, search.at) as point:
        return predict(point, search, done)


def predict(point: Point, search: Search, done: Callable[[Step], None] = lambda _: None) -> Prediction:
    """Follow the quantity of ``search`` from its start, to its far end or in steps that double; where the loop has
    become unstable, search the root of the growth of the mode that did."""
    quantity, start = search.quantity, search.start
    steps: dict[float, Step] = {}

    def at(value: float) -> Linearisation:
        value = float(quantity.checked(value))
        if value not in steps:
            steps[value] = Step(value, point.with_value(quantity, value))
            done(steps[value])
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
    return answer(value, at(value).like(grown))
