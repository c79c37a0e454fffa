"""Numbers of a run that steps: how many steps, how long they are, how upright, how well the feet land, how smoothly
the control law changes. docs/metrics.md says what each of them compares."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from central_controller.behaviours.step import State
from hil.analysis.derived import Derived
from hil.analysis.steps import Step, steps_of, touch_downs
from hil.record.signals import Signals

STEADY_FROM = 3  # touch-downs: the first two steps begin from rest
_SWITCH_NS = 2_000_000  # for so long after a switch a change of torque is taken for its doing
LIFT, TOUCHDOWN = (State.UNLOADING, State.LIFTING), (State.LOADING, State.DOUBLE)  # what is switched into


def stepping_metrics(run: Derived) -> dict[str, Any]:
    """Nothing for a run without steps; else ``steps``, ``step_time_mean`` [s], ``orientation_error_max_steady`` [rad],
    ``foot_placement_error_rms`` and ``_max`` [m], ``torque_step_at_lift_max`` and ``torque_step_at_touchdown_max`` [N m
    per control tick]."""
    controller = run.controller
    if "steps" not in controller:
        return {}
    steps = steps_of(controller, run.world)
    errors = np.array([np.hypot(*step.error) for step in steps if np.isfinite(step.error).all()])
    touches = touch_downs(controller)
    times = np.diff(controller.seconds[touches])
    changes = torque_changes(controller)
    return {
        "steps": _count(controller["steps"]),
        "step_time_mean": float(np.mean(times)) if len(times) else None,
        "orientation_error_max_steady": _steady_orientation(run, touches),
        "foot_placement_error_rms": float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else None,
        "foot_placement_error_max": float(np.max(errors)) if len(errors) else None,
        "torque_step_at_lift_max": _largest(torque_step(controller, changes, step, LIFT) for step in steps),
        "torque_step_at_touchdown_max": _largest(torque_step(controller, changes, step, TOUCHDOWN) for step in steps),
    }


def torque_changes(controller: Signals) -> np.ndarray:
    """Largest change of a commanded torque from the row before, (n,), N m."""
    torque = controller.group("torque_command")
    return np.abs(np.diff(torque, axis=0, prepend=torque[:1])).max(axis=1, initial=0.0)


def torque_step(controller: Signals, changes: np.ndarray, step: Step, switches: Sequence[State]) -> float | None:
    """The largest of ``changes`` in the ticks in which ``step`` enters one of ``switches``, and 2 ms after, N m."""
    found = []
    for state in switches:
        if (row := step.began.get(state)) is not None:
            until = int(np.searchsorted(controller.times, controller.times[row] + _SWITCH_NS, side="right"))
            found.append(float(changes[row:until].max()))
    return _largest(found)


def _steady_orientation(run: Derived, touches: np.ndarray) -> float | None:
    """Between the touch-down that is STEADY_FROM-th and the last one: neither the start nor what ended the run."""
    if len(touches) <= STEADY_FROM:
        return None
    return _largest(np.abs(run.orientation_error[touches[STEADY_FROM - 1] : touches[-1]]).max(axis=1))


def _largest(values: Iterable[float | None]) -> float | None:
    known = [float(value) for value in values if value is not None and np.isfinite(value)]
    return max(known, default=None)


def _count(values: np.ndarray) -> int:
    known = values[np.isfinite(values)]
    return int(known[-1]) if len(known) else 0
