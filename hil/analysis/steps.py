"""The steps of a run, found in its record: which foot, when each state began, where it should land and where it did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from central_controller.behaviours.step import State
from hil.record.signals import Signals

PHASES = (State.UNLOADING, State.LIFTING, State.LANDING, State.LOADING, State.DOUBLE)  # of a step, in order
_AT_REST_NS = 10_000_000  # after touch-down


@dataclass(frozen=True)
class Step:
    """One step whose foot has landed. Rows are those of the channel ``controller``.

    began: first row of each of its PHASES, as far as the run came. end: the row after its last one. planned_at: row of
    the plan that it landed by. planned, landed: place of the swing foot, from the stance foot (2,) [m], as the
    controller wanted it and as the physics had it just after touch-down; NaN where unknown.
    """

    number: int
    swing: str
    stance: str
    began: Mapping[State, int]
    end: int
    planned_at: int | None
    planned: np.ndarray
    landed: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Where the foot landed less where it should have, (2,), m."""
        return self.landed - self.planned

    def durations(self, seconds: np.ndarray) -> dict[State, float]:
        """How long each of its states took [s], of those that the run saw the end of. ``seconds``: of all rows."""
        bounds = [*self.began.items(), (None, self.end)]
        return {
            state: float(seconds[after] - seconds[row])
            for (state, row), (_, after) in pairwise(bounds)
            if state is not None and after < len(seconds)
        }


def touch_downs(controller: Signals) -> np.ndarray:
    """Rows at which a foot met the ground."""
    return _entries(controller["state"], State.LOADING)


def steps_of(controller: Signals, world: Signals) -> list[Step]:
    """All steps of a run whose foot has landed; none for a run that does not step."""
    if "steps" not in controller or not len(controller) or not len(world):
        return []
    state = controller["state"]
    starts = [*_entries(state, State.UNLOADING).tolist(), len(state)]
    found: list[Step] = []
    for start, end in pairwise(starts):
        rows = {phase: start + at for phase in PHASES if (at := _first(state[start:end] == phase)) is not None}
        if State.LOADING in rows:
            found.append(_step(len(found) + 1, controller, world, rows, end))
    return found


def _step(number: int, controller: Signals, world: Signals, began: Mapping[State, int], end: int) -> Step:
    touch = began[State.LOADING]
    feet = controller.members("carries")
    swing = int(controller[f"carries.{feet[0]}"][touch] != 0)
    swinging, standing = feet[swing], feet[1 - swing]
    planned_at = _last_plan(controller, began.get(State.LIFTING, touch), touch)
    planned = landed = np.full(2, np.nan)
    late = world.latest_before(controller.times[touch : touch + 1] + _AT_REST_NS)[0]
    if planned_at is not None:
        planned = _place(controller, "plan.foot", touch) - _place(controller, f"foot.{standing}", touch)
    landed = _place(world, f"foot.{swinging}", late) - _place(world, f"foot.{standing}", late)
    return Step(number, swinging, standing, began, end, planned_at, planned, landed)


def _place(table: Signals, name: str, row: int) -> np.ndarray:
    return np.array([table[f"{name}.{axis}"][row] for axis in "xy"])


def _last_plan(controller: Signals, lift: int, touch: int) -> int | None:
    """The row in which the plan changed last between these two; None: it did not."""
    columns = [controller.index(f"plan.{name}") for name in controller.members("plan")]
    plan = controller.data[max(lift - 1, 0) : touch + 1, columns]
    changed = np.flatnonzero(np.any(plan[1:] != plan[:-1], axis=1))
    return int(max(lift - 1, 0) + 1 + changed[-1]) if len(changed) else None


def _entries(state: np.ndarray, wanted: State) -> np.ndarray:
    inside = state == wanted
    return np.flatnonzero(inside[1:] & ~inside[:-1]) + 1


def _first(mask: np.ndarray) -> int | None:
    return int(mask.argmax()) if mask.any() else None
