"""What is asked of the linear loop at many points: its modes, or where a quantity makes it unstable. As calls that can
be spread over processes, and that go on where they were ended, like a sweep's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.errors import UserError
from hil.lab.axes import Axis, points, written
from hil.lab.cell_journal import Cell, CellJournal
from hil.lab.linear.linearisation import SCALES, Linearisation
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.linear.prediction import predict
from hil.lab.margin import Search
from hil.lab.quantity import Quantity, Value
from hil.lab.sweep import Row, Runner
from hil.scenario import Scenario

_SLOWEST, _FASTEST = 0.5, 100.0  # Hz: of oscillations; what is faster are samples that alternate


@dataclass(frozen=True)
class Follow:
    """A quantity to be followed from ``near``, which ought to be stable, to where the loop is not, ``far`` at most."""

    quantity: Quantity
    near: float
    far: float
    resolution: float


@dataclass(frozen=True)
class LinearPlan:
    """The loop of ``scenario`` as it stands at ``at`` s, at all points of ``axes``; with ``follow`` its boundary along
    that quantity at each, without its least damped oscillation.

    Of the axes one at most may be of a quantity that cannot be injected. Raises UserError.
    """

    scenario: Scenario
    axes: tuple[Axis, ...]
    at: float
    follow: Follow | None = None

    def __post_init__(self) -> None:
        fixed = [a.quantity.key for a in self.axes if not a.quantity.injectable]
        if len(fixed) > 1:
            raise UserError(
                f"{' and '.join(fixed)}: only one of them can be varied in a linear loop, none is injectable"
            )
        if self.follow is not None and len(fixed) < len(self.axes):
            raise UserError("where a quantity is followed, no other is injected")

    @property
    def points(self) -> list[tuple[Value, ...]]:
        return points(self.axes)

    def manifest(self) -> dict[str, Any]:
        """All that determines the answers, and the machine that began."""
        from hil.run import versions

        machine = versions()
        follow = self.follow
        return {
            "scenario": self.scenario.model_dump(mode="json"),
            "axes": written(self.axes),
            "at": self.at,
            "scales": list(SCALES),
            "follow": follow and [follow.quantity.key, follow.near, follow.far, follow.resolution],
            "versions": {name: machine[name] for name in machine if name not in ("python", "platform", "compiler")},
            "machine": {name: machine[name] for name in ("python", "platform", "compiler")},
        }

    def call(self, number: int) -> tuple[Any, ...]:
        """The arguments of ``ask``."""
        values = zip((a.quantity for a in self.axes), self.points[number], strict=True)
        return self.scenario, self.at, dict(values), self.follow, (number, 0)


_kept = threading.local()  # a worker's standing robot waits for its next question


def ask(
    scenario: Scenario, at: float, values: dict[Quantity, Value], follow: Follow | None, cell: Cell
) -> tuple[Cell, Row]:
    """Answer at one point. The row: ``refused`` (why, or None), and what ``oscillation`` or ``boundary`` has."""
    try:
        home = _home(scenario, at)
        fixed = [(q, value) for q, value in values.items() if not q.injectable]
        if not fixed:
            return cell, _answer(home, values, follow)
        with home.elsewhere(*fixed[0]) as point:
            return cell, _answer(point, values, follow)
    except UserError as error:  # the robot does not stand like that
        return cell, {"refused": str(error)}


def _home(scenario: Scenario, at: float) -> OperatingPoint:
    kept = getattr(_kept, "point", None)
    if kept is None or kept[0] != (scenario, at):
        if kept is not None:
            _kept.point = None
            kept[1].close()
        kept = _kept.point = (scenario, at), OperatingPoint(scenario, at)
    return kept[1]


def _answer(point: OperatingPoint, values: dict[Quantity, Value], follow: Follow | None) -> Row:
    if follow is not None:
        return boundary(point, follow)
    return oscillation(point.linearise({q.key: value for q, value in values.items() if q.injectable}))


def oscillation(loop: Linearisation) -> Row:
    """Of the least damped oscillation: damping (ratio), frequency [Hz], growth [1/s], mode: what takes part. doubt: why
    it is not to be trusted, or None."""
    waves = [m for m in loop.modes if _SLOWEST < m.frequency < _FASTEST]
    mode = min(waves, key=lambda m: m.damping)
    return {
        "refused": None, "doubt": loop.doubt(), "damping": mode.damping, "frequency": mode.frequency,
        "growth": mode.growth, "mode": mode.told(3),
    }  # fmt: skip


def boundary(point: OperatingPoint, follow: Follow) -> Row:
    """value: where the loop becomes unstable; None if it is stable up to the end (``unstable_at_start`` false), or not
    even stable at the start. frequency [Hz], mode: of what grows there. doubt: why it is not to be trusted, or None."""
    search = Search(point.scenario, follow.quantity, point.at, follow.near, follow.far, follow.resolution)
    found = predict(point, search)
    return {
        "refused": None, "doubt": found.doubt, "value": found.value,
        "unstable_at_start": found.value is None and found.mode is not None,
        "frequency": None if found.mode is None else found.mode.frequency,
        "mode": None if found.mode is None else found.mode.told(3),
    }  # fmt: skip


def answers(
    plan: LinearPlan, directory: Path, runner: Runner, told: Callable[[int], None] = lambda _: None
) -> list[Row]:
    """The rows of all points, in their order; those that ``directory`` holds already are not asked for again.

    told: is told how many there are, at the start and after each.
    """
    with CellJournal(directory, plan.manifest()) as journal:
        numbers = range(len(plan.points))
        told(len(journal.rows))
        for cell, row in runner(ask, [plan.call(n) for n in numbers if (n, 0) not in journal.rows]):
            journal.append(cell, row)
            told(len(journal.rows))
        return [journal.rows[n, 0] for n in numbers]
