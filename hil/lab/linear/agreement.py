"""Where a boundary found by runs and a predicted one part, and why: row by row of a map, or along one axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hil.lab.linear.curve import Critical, Curve
from hil.lab.linear.prediction import STICTION, Prediction, parting
from hil.lab.margin import Search
from hil.lab.places import Place, Places, crossings
from hil.lab.quantity import Quantity


@dataclass(frozen=True)
class Agreement:
    """One row: value of the other axis (None: there is none), boundary measured and predicted [SI], None where there is
    none; mode: what grows at the predicted one, with its frequency; sentence: whether they part, and why."""

    across: float | None
    measured: float | None
    predicted: float | None
    mode: str
    frequency: float | None
    sentence: str

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def agreements(found: Places, curve: Curve) -> list[Agreement]:
    """One per point of ``curve`` of which ``found``, a grid, has a row."""
    index = [q.key for q in found.quantities].index(curve.along.key)
    return [
        agreement(found, curve.along, row, curve.start, curve.end, point)
        for point in curve.points
        if (row := [place for place in found.rows if place[1 - index] == point.across])
    ]


def agreement(
    found: Places, along: Quantity, row: Sequence[Place], start: float, end: float, point: Critical, across: bool = True
) -> Agreement:
    """Of the places ``row``, outwards from ``start`` to ``end``, with ``point``; ``across``: whether there is another
    axis."""
    index = [q.key for q in found.quantities].index(along.key)
    low, high = min(start, end), max(start, end)
    inside = sorted((p for p in row if low <= float(p[index]) <= high), key=lambda p: abs(float(p[index]) - start))
    measured, spacing, why = None, 0.0, ""
    reasons: list[str] = []
    first: list[str] = []
    if not inside:
        why = "no run"
    elif found.share(inside[0]) < 0.5:
        why = f"unstable at {along.shown(inside[0][index])} already: {found.reason(inside[0])}"
    else:
        values, share = [float(p[index]) for p in inside], [found.share(p) for p in inside]
        crossed = crossings(values, share, found.logs[index])
        if crossed:
            measured, before = crossed[0]
            spacing = abs(values[before + 1] - values[before])
            reasons, first = [found.reason(inside[before + 1])], found.came_first(inside[before + 1])
        else:
            why = f"stable up to {along.shown(inside[-1][index])}, where the sweep ends"
    if point.value is None or measured is None:
        measured_text = why or f"found at {along.shown(measured or 0.0)}, by {reasons[0]}"
        sentence = measured_text if point.value is not None else f"predicted: {point.why}; runs: {measured_text}"
        stands = inside and found.share(inside[0]) >= 0.5
        if point.nowhere and stands and found.scenario.world.friction_scale > 0.0:
            sentence += f": {STICTION}"
    else:
        search = Search(found.scenario, along, found.at, start, end)
        apart = parting(search, Prediction(point.value, None, ()), measured, reasons, first, spacing)
        sentence = apart or "the same, as far as the distance of the runs tells"
        if apart and reasons[0] not in apart:
            sentence += f"; it ends by: {reasons[0]}"
    if point.doubt is not None:
        sentence = f"the prediction is {point.doubt}; {sentence}"
    return Agreement(point.across if across else None, measured, point.value, point.mode, point.frequency, sentence)
