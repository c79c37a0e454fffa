"""A predicted boundary over two quantities: where the linear loop becomes unstable along one, for values of the other.

From one value to the next by continuation: the search begins where the last one ended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

from hil.errors import UserError
from hil.lab.linear.linearisation import Linearisation
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.quantity import Quantity
from hil.scenario import Scenario

_NOWHERE = "unstable at {start} already"
_FINENESS = 200  # the range over this is how fine a critical value is
_FIRST = 16  # the range over this: the first step of a search that has a guess


Loop = Callable[[float], Linearisation]  # the linearised loop at a value of the quantity that is searched along


@dataclass(frozen=True)
class Critical:
    """across: the value of the other quantity. value: where the loop becomes unstable along the one; None if it does
    not, and then why; nowhere: because it is unstable from the start. frequency [Hz], mode: of what grows there. doubt:
    why the loop there is not to be trusted, if it is not."""

    across: float
    value: float | None
    why: str = ""
    frequency: float | None = None
    mode: str = ""
    nowhere: bool = False
    doubt: str | None = None


@dataclass(frozen=True)
class Curve:
    """One boundary. start, end: between which it was looked for, outwards."""

    along: Quantity
    across: Quantity
    start: float
    end: float
    points: tuple[Critical, ...]

    def segments(self, along_is_x: bool) -> list[list[tuple[float, float]]]:
        """Points (x, y) of its parts, in SI units, without gaps."""
        parts: list[list[tuple[float, float]]] = [[]]
        for point in self.points:
            if point.value is None:
                parts.append([])
            else:
                parts[-1].append((point.value, point.across) if along_is_x else (point.across, point.value))
        return [part for part in parts if part]


def sides(along: Quantity, low: float, high: float) -> list[tuple[float, float]]:
    """From where to where boundaries are looked for so as to know of those from ``low`` to ``high``: outwards from the
    scenario's own value, where the robot is expected to stand."""
    nominal = float(along.nominal)
    if nominal <= low:
        return [(nominal, high)]
    if nominal >= high:
        return [(nominal, low)]
    return [(nominal, high), (nominal, low)]


def predicted_curves(
    scenario: Scenario, at: float, along: Quantity, low: float, high: float, across: Quantity,
    values: Sequence[float], done: Callable[[int], None] = lambda _: None,
) -> list[Curve]:  # fmt: skip
    """Boundaries along ``along`` as ``sides`` of ``low`` and ``high`` says, for each of ``values`` of ``across``; SI.

    The robot is linearised as it stands at ``at`` s. done: is told how many linearisations there have been. Raises
    UserError where it does not stand at all.
    """
    counted = 0

    def count() -> None:
        nonlocal counted
        counted += 1
        done(counted)

    ends = sides(along, low, high)
    points: list[list[Critical]] = [[] for _ in ends]
    with OperatingPoint(scenario, at) as home:
        for value in values:
            try:
                loop, close = _loop(home, along, across, value)
            except UserError as error:
                for own in points:
                    own.append(Critical(value, None, str(error)))
                continue
            try:
                known = remembered(loop, along, count)
                for own, (start, end) in zip(points, ends, strict=True):
                    guess = next((point.value for point in reversed(own) if point.value is not None), None)
                    own.append(critical(known, value, along, start, end, guess))
            finally:
                close()
    return [
        Curve(along, across, start, end, tuple(own)) for own, (start, end) in zip(points, ends, strict=True)
    ]  # fmt: skip


def remembered(loop: Loop, along: Quantity, count: Callable[[], None] = lambda: None) -> Loop:
    """``loop``, asked once for each value; ``count`` is called when it is."""
    known: dict[float, Linearisation] = {}

    def at(value: float) -> Linearisation:
        value = float(along.checked(value))
        if value not in known:
            known[value] = loop(value)
            count()
        return known[value]

    return at


def _loop(home: OperatingPoint, along: Quantity, across: Quantity, value: float) -> tuple[Loop, Callable[[], None]]:
    """The loop with ``across`` at ``value``, and what frees it."""
    if across.injectable:

        def injected(x: float) -> Linearisation:
            if along.injectable:
                return home.linearise({along.key: x, across.key: value})
            with home.elsewhere(along, x) as moved:
                return moved.linearise({across.key: value})

        return injected, lambda: None
    moved = home.elsewhere(across, value)
    return lambda x: moved.with_value(along, x), moved.close


def critical(
    loop: Loop, across: float, along: Quantity, start: float, end: float, guess: float | None = None
) -> Critical:
    """The first change from stable to unstable from ``start`` to ``end``, near ``guess`` if there is one."""
    span = end - start

    def growth(value: float) -> float:
        return loop(value).growth

    try:
        bracket = _bracket(growth, start, end, span / _FIRST, guess)
        if isinstance(bracket, str):
            why = bracket.format(start=along.shown(start), end=along.shown(end))
            return Critical(across, None, why, nowhere=bracket is _NOWHERE)
        inner, outer = bracket
        value = inner if inner == outer else float(brentq(growth, inner, outer, xtol=0.5 * abs(span) / _FINENESS))
    except UserError as error:
        return Critical(across, None, str(error))
    grown = loop(outer).dominant
    near = loop(value)
    mode = near.dominant if near.growth >= 0.0 else near.like(grown)
    return Critical(across, value, "", mode.frequency, mode.told(), doubt=near.doubt())


def _bracket(
    growth: Callable[[float], float], start: float, end: float, step: float, guess: float | None
) -> tuple[float, float] | str:
    """A stable and an unstable value, the latter further from ``start``; or why there are none."""
    if guess is None:
        if growth(start) >= 0.0:
            return _NOWHERE
        inner = start
        for share in (0.125, 0.25, 0.5, 1.0):  # not at once to the end: what is far out need not be the first
            outer = start + share * (end - start)
            if growth(outer) >= 0.0:
                return inner, outer
            inner = outer
        return "stable up to {end}"
    value = guess
    if growth(value) < 0.0:
        while value != end:
            further = value + step
            further = end if (further - end) * math.copysign(1.0, step) >= 0.0 else further
            if growth(further) >= 0.0:
                return value, further
            value, step = further, 2.0 * step
        return "stable up to {end}"
    while value != start:
        nearer = value - step
        nearer = start if (nearer - start) * math.copysign(1.0, step) <= 0.0 else nearer
        if growth(nearer) < 0.0:
            return nearer, value
        value, step = nearer, 2.0 * step
    return _NOWHERE
