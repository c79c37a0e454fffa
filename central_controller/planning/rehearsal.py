"""Walking with nothing but the pendulum: the planner in closed loop with the model that it plans by."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.velocity_reversal import Plan, VelocityReversalPlanner


class RehearsedStep(NamedTuple):
    """One step: the foot that stood, the plan made on it, and the way until the stance foot changed."""

    stance: Foot
    plan: Plan
    path: np.ndarray  # rows t, x, y, vx, vy; t from the first step's start [s]


def _at_origin(time: float) -> tuple[float, float]:
    return 0.0, 0.0


def _on_floor(x: float) -> float:
    return 0.0


def rehearse(
    planner: VelocityReversalPlanner,
    pendulum: Pendulum,
    start: PendulumState,
    stance: Foot,
    side: int,
    step_time: float,
    steps: int,
    goal: Callable[[float], tuple[float, float]] = _at_origin,
    ground: Callable[[float], float] = _on_floor,
) -> list[RehearsedStep]:
    """Walk ``steps`` steps on the plant ``pendulum``, which may differ from the planner's.

    Args:
        start: of the centre of mass, just after ``stance`` has become the stance foot.
        side: of the foot that swings first.
        step_time: T without extension [s].
        goal: x_d, y_d at a time.
        ground: its height at x [m]. A step is planned once more when the ground under the planned foot is not where it
            was believed to be.
    """
    state, time, walked = start, 0.0, []
    for _ in range(steps):
        plan = planner.plan(state, stance, side, step_time, goal(time + step_time), stance.z)
        height = ground(plan.foot.x)
        if height != stance.z:
            plan = planner.plan(state, stance, side, step_time, goal(time + step_time), height)
            plan = plan._replace(foot=plan.foot._replace(z=ground(plan.foot.x)))
        path = pendulum.path(state, stance, plan.remaining, 0.01)
        state = PendulumState(*path[-1, 1:].tolist())
        path[:, 0] += time
        walked.append(RehearsedStep(stance, plan, path))
        time += plan.remaining
        stance, side = plan.foot, -side
    return walked
