"""Foot placement by "constant time to velocity reversal" (Kim 2018 §4.3).

The present state is carried on to the switch of the stance foot. The next foot is where the centre of mass, standing
on it, comes to rest in x after t'_x and in y after t'_y. On a level surface that is (4.32); on any other it is searched
for with Newton's method (shooting), which converges since the velocity falls with the foot's place, (4.25). The pull
towards the goal is added to it, with the sign that stabilises (the printed (4.33) has an eigenvalue above 1):

    p = (foot of the velocity reversal) + κ (x_switch − x_goal)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from central_controller.planning.config import PlannerConfig
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.reach import nearest_reachable

_SPEED_TOLERANCE = 1e-6  # m/s left after t'
_ITERATIONS = 10  # the source's bound; on a level surface it takes one
_DIFFERENCE = 1e-4  # m, of the numerical derivative
_EXTENSION_STEP = 0.005  # s


class Plan(NamedTuple):
    """Where to step next, and what was predicted on the way."""

    foot: Foot  # to land here; z as the caller gave it
    wanted: tuple[float, float]  # before it was brought into reach, m
    projected: bool  # whether it had to be
    switching: PendulumState  # of the centre of mass when the stance foot changes
    remaining: float  # s until then, extension included
    extension: float  # s, of the swing
    iterations: int  # of Newton's method
    converged: bool


class VelocityReversalPlanner:
    """Plans one step at a time; keeps nothing between plans."""

    def __init__(self, config: PlannerConfig, pendulum: Pendulum) -> None:
        self._config = config
        self._pendulum = pendulum

    def plan(
        self,
        state: PendulumState,
        stance: Foot,
        side: int,
        remaining: float,
        goal: tuple[float, float],
        landing_height: float = 0.0,
    ) -> Plan:
        """Plan the next foot. Without ``lateral`` in the configuration all of the plan has the stance foot's y.

        Args:
            state: of the centre of mass now, world.
            stance: foot that stands now, world.
            side: of the swing foot: ``reach.LEFT`` or ``reach.RIGHT``.
            remaining: time until the stance foot changes [s].
            goal: x_d, y_d of (4.33) [m], which may move from plan to plan.
            landing_height: z of the ground where the foot will land [m].
        """
        config = self._config
        if not config.lateral:  # at rest above the stance foot, the pendulum stays in the plane
            state, goal = state._replace(y=stance.y, vy=0.0), (goal[0], stance.y)
        switching, extension = self._pendulum.advance(state, stance, remaining, config.integration_step), 0.0
        if config.lateral:
            switching, extension = self._extended(switching, stance, side, goal[1], landing_height)
        ratio = self._pendulum.mass_ratio
        guess = (
            switching.x + switching.vx * self._reach_ahead(switching, landing_height, config.reversal_time_x, ratio),
            switching.y + switching.vy * self._reach_ahead(switching, landing_height, config.reversal_time_y),
        )
        x, y, iterations, converged = self._reversal(switching, guess, landing_height)
        if not converged:  # hopelessly far from any step; what a level surface would ask for is brought into reach
            x, y = guess
        wanted = (
            x + config.kappa_x * self._away(switching.x, goal[0]),
            y + config.kappa_y * self._away(switching.y, goal[1]) + side * config.lateral_bias,
        )
        if not config.lateral:
            wanted = wanted[0], stance.y
        foot = nearest_reachable(config.reach, side, wanted, stance, (switching.x, switching.y))
        if not config.lateral:
            foot = foot[0], stance.y
        return Plan(
            Foot(*foot, landing_height), wanted, foot != wanted, switching, remaining + extension, extension,
            iterations, converged,
        )  # fmt: skip

    def path(self, plan: Plan, duration: float, step: float = 0.005) -> np.ndarray:
        """Rows t, x, y, vx, vy predicted after the switch, on the planned foot; t from the switch [s]."""
        return self._pendulum.path(plan.switching, plan.foot, duration, step)

    def _away(self, position: float, goal: float) -> float:
        """How far from the goal, as far as it pulls."""
        limit = self._config.goal_distance
        return min(limit, max(-limit, position - goal))

    def _reach_ahead(self, state: PendulumState, ground: float, reversal_time: float, ratio: float = 1.0) -> float:
        """coth(ω t')/ω [s] of (4.32) at the height of ``state`` above the ``ground``; ``ratio``: of masses, (7.5)."""
        omega = math.sqrt(ratio * self._pendulum.gravity / (self._pendulum.surface(state.x, state.y)[0] - ground))
        return 1.0 / (omega * math.tanh(omega * reversal_time))

    def _extended(
        self, switching: PendulumState, stance: Foot, side: int, goal: float, ground: float
    ) -> tuple[PendulumState, float]:
        """The switch put off until the step is wide and the centre of mass fast enough, by ``extension.limit`` at
        most. The width is judged with the pendulum of the height at the switch, without shooting. Nothing is put off
        when the centre of mass falls inwards: waiting would bring the feet closer still.
        """
        config, pendulum = self._config, self._pendulum
        wanted = config.extension
        extension = 0.0
        while extension + _EXTENSION_STEP <= wanted.limit + 1e-9:
            y, vy = switching.y, switching.vy
            outwards = side * vy
            width = side * (
                y - stance.y
                + vy * self._reach_ahead(switching, ground, config.reversal_time_y)
                + config.kappa_y * self._away(y, goal)
            ) + config.lateral_bias  # fmt: skip
            if width >= wanted.step_width and outwards >= wanted.lateral_speed:
                break
            acceleration = pendulum.acceleration(switching, stance)[1]
            if outwards <= 0.0 or side * acceleration <= 0.0:
                break
            switching = pendulum.advance(switching, stance, _EXTENSION_STEP, _EXTENSION_STEP)
            extension += _EXTENSION_STEP
        return switching, extension

    def _velocity_after(self, start: PendulumState, x: float, y: float, z: float) -> tuple[float, float]:
        """x' after t'_x and y' after t'_y, standing on (x, y, z) from ``start`` on."""
        config, foot = self._config, Foot(x, y, z)
        tx, ty, step = config.reversal_time_x, config.reversal_time_y, config.integration_step
        first = self._pendulum.advance(start, foot, min(tx, ty), step)
        if tx == ty:
            return first.vx, first.vy
        second = self._pendulum.advance(first, foot, abs(tx - ty), step)
        return (second.vx, first.vy) if tx > ty else (first.vx, second.vy)

    def _reversal(
        self, switching: PendulumState, guess: tuple[float, float], ground: float
    ) -> tuple[float, float, int, bool]:
        """Newton's method with numerical derivatives for the foot on which both velocities vanish in their time."""
        after, d = self._velocity_after, _DIFFERENCE
        x, y = guess
        u, v = after(switching, x, y, ground)
        for iteration in range(_ITERATIONS + 1):
            if abs(u) < _SPEED_TOLERANCE and abs(v) < _SPEED_TOLERANCE:
                return x, y, iteration, True
            ux, vx = after(switching, x + d, y, ground)
            uy, vy = after(switching, x, y + d, ground)
            a, b, c, e = (ux - u) / d, (uy - u) / d, (vx - v) / d, (vy - v) / d
            determinant = a * e - b * c
            if not abs(determinant) > 0.0:
                break
            x -= (e * u - b * v) / determinant
            y -= (a * v - c * u) / determinant
            u, v = after(switching, x, y, ground)
        return x, y, _ITERATIONS, False
