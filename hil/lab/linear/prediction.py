"""Where a quantity makes the linearised loop unstable: its dominant mode followed from a stable value outwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from scipy.optimize import brentq

from hil.errors import UserError
from hil.lab.linear.linearisation import Linearisation, Mode
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.margin import Search
from hil.lab.quantity import Quantity, Value

_FINENESS = 100  # without a resolution: the distance from the start over this
_COARSE = 16  # of the way to where the robot does not stand: how near to it is looked


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
    mode: what grows just beyond it, or from the start. steps: all that was looked at, by value. furthest: the last
    stable value of a search that found none; refused: why it ended there, where the robot does not stand further out.
    """

    value: float | None
    mode: Mode | None
    steps: tuple[Step, ...]
    furthest: float | None = None
    refused: str | None = None

    @property
    def doubt(self) -> str | None:
        """Why it is not to be trusted, a sentence; None if it is. Where there is a value, the two steps next to it
        count, else all."""
        value = self.value
        near = self.steps if value is None else sorted(self.steps, key=lambda step: abs(step.value - value))[:2]
        return next((why for step in near if (why := step.linearisation.doubt()) is not None), None)

    def record(self) -> dict[str, Any]:
        """For JSON, in SI units."""
        return {
            "doubt": self.doubt,
            "furthest": self.furthest,
            "refused": self.refused,
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
    search: Search, prediction: Prediction, margin: float | None, reasons: Sequence[str],
    came_first: Sequence[str] = (), resolution: float = 0.0,
) -> str | None:  # fmt: skip
    """Why ``margin`` and prediction are further apart than a period of the controller, or if it is no time a twentieth:
    one sentence; None if they are not, or not more than ``resolution``. ``reasons``: verdicts of the smallest values
    that were found unstable; ``came_first``: the first signs of the same runs."""
    if margin is None:
        return None
    rubs = search.scenario.world.friction_scale > 0.0
    if prediction.value is None:
        if prediction.mode is not None:
            return f"the linear loop is unstable from the start: {STICTION}" if rubs else None
        return f"the linear loop does not become unstable; what ends the runs is {_ending(reasons, came_first)}"
    apart = margin - prediction.value
    near = 1.0 / search.scenario.controller.rate if search.quantity.unit == "s" else 0.05 * abs(prediction.value)
    if abs(apart) <= max(near, resolution):
        return None
    outwards = apart if search.far is None or search.far > search.start else -apart
    told = search.quantity.shown(abs(apart))
    if outwards > 0.0 and rubs:
        return f"{told} beyond the prediction: {STICTION}"
    side = "beyond" if outwards > 0.0 else "short of"
    return f"{told} {side} the prediction, and not by growth from small deviations: {_ending(reasons, came_first)}"


def _ending(reasons: Sequence[str], came_first: Sequence[str]) -> str:
    """Of runs that ended by something that no linear loop has: what."""
    common, first = _most(reasons) or "unknown", _most(came_first)
    kind = next((f"{kind}: " for begins, kind in _KINDS.items() if common.startswith(begins)), "")
    if first.startswith("saturation"):
        kind = f"{first} came first, then {kind}"
    return f"{kind}{common}"


def _most(texts: Sequence[str]) -> str:
    """The most frequent one, of several the first; empty if there are none."""
    return max(dict.fromkeys(texts), key=texts.count, default="")


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

    def answer(value: float | None, mode: Mode | None, *further: Any) -> Prediction:
        return Prediction(value, mode, tuple(steps[key] for key in sorted(steps)), *further)

    if at(start).growth >= 0.0:
        return answer(None, at(start).dominant)
    low, high, refused = _bracket(at, search)
    if high is None:
        return answer(None, None, low, refused)
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


def _bracket(at: Callable[[float], Linearisation], search: Search) -> tuple[float, float | None, str | None]:
    """A stable value and an unstable one further out. None of the latter: there is none to the end of the search, or to
    where the robot does not stand, and then why."""
    low = search.start
    for high in search.outwards():
        try:
            if at(high).growth >= 0.0:
                return low, high, None
        except UserError as error:
            return _bracket_before(at, low, high, str(error))
        low = high
    return low, None, None


def _bracket_before(
    at: Callable[[float], Linearisation], low: float, high: float, refused: str
) -> tuple[float, float | None, str | None]:
    """The same between ``low``, which is stable, and ``high``, where the robot does not stand."""
    fine = abs(high - low) / _COARSE
    while abs(high - low) > fine:
        middle = 0.5 * (low + high)
        try:
            if at(middle).growth >= 0.0:
                return low, middle, None
            low = middle
        except UserError as error:
            high, refused = middle, str(error)
    return low, None, refused
