"""Numbers of a run that steps: how many steps, how long they are, how well the feet land."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.record.signals import Signals

_LOADING = 5  # of central_controller.behaviours.step.State
_AT_REST_NS = 10_000_000  # after touch-down


def stepping_metrics(controller: Signals, world: Signals) -> dict[str, Any]:
    """``steps``, ``step_time_mean`` [s] from touch-down to touch-down, ``foot_placement_error_rms`` and ``_max`` [m]:
    where a foot came to stand, as seen from the foot that stood, against where the planner wanted it. Nothing for a
    run without steps."""
    if "steps" not in controller.names:
        return {}
    touches = touch_downs(controller)
    errors = [error for row in touches if (error := _placement_error(controller, world, row)) is not None]
    times = np.diff(controller.seconds[touches])
    return {
        "steps": int(controller["steps"][-1]) if len(controller) else 0,
        "step_time_mean": float(np.mean(times)) if len(times) else None,
        "foot_placement_error_rms": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
        "foot_placement_error_max": float(np.max(errors)) if errors else None,
    }


def touch_downs(controller: Signals) -> np.ndarray:
    """Rows at which a foot met the ground."""
    loading = controller["state"] == _LOADING
    return np.flatnonzero(loading[1:] & ~loading[:-1]) + 1


def _placement_error(controller: Signals, world: Signals, row: int) -> float | None:
    feet = controller.members("carries")
    swing = next((k for k in range(2) if controller[f"carries.{feet[k]}"][row] == 0), None)
    late = world.latest_before(controller.times[row : row + 1] + _AT_REST_NS)
    if swing is None or late[0] < 0:
        return None
    stance = 1 - swing
    planned = [
        controller[f"plan.foot.{axis}"][row] - controller[f"foot.{feet[stance]}.{axis}"][row] for axis in "xy"
    ]
    found = [
        world[f"foot.{feet[swing]}.{axis}"][late[0]] - world[f"foot.{feet[stance]}.{axis}"][late[0]] for axis in "xy"
    ]
    return float(np.hypot(found[0] - planned[0], found[1] - planned[1]))
