"""Where a stepping robot puts its feet: the ground as it is known, the pendulum as which the centre of mass falls, and
the planner that reads it (Kim 2018 §4.3, §7.2.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from central_controller.estimation.pendulum_observer import PendulumObserver
from central_controller.planning.height_surface import over_blocks
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.reach import LEFT, RIGHT, clear_of_edges
from central_controller.planning.velocity_reversal import Plan, VelocityReversalPlanner
from central_controller.stepping_config import StepConfig
from robots.description import Robot
from robots.terrain import Block, ground_height

_SIDES = (RIGHT, LEFT)  # of the feet, in the robot's order


class Footholds:
    """Feet are numbered in the robot's order. All places are in the world's frame.

    Args:
        rate: of the controller, Hz.
        blocks: what the controller knows of the terrain.
        com: x, y, z [m] of the centre of mass when stepping begins.
        ground: height [m] of the ground there, under the feet's centres.
    """

    def __init__(
        self, config: StepConfig, robot: Robot, rate: float, blocks: Sequence[Block], com: Sequence[float],
        ground: float,
    ) -> None:  # fmt: skip
        x, y, self.height = com
        self._config, self._blocks, self._ground = config, blocks, ground
        self.level = not blocks  # the ground: the height of the centre of mass is held
        self._gravity = robot.gravity
        self.middle = (x, y)  # where stepping began
        self.levels = [ground] * len(_SIDES)  # of the ground under each foot, or where it stood last
        self._stood = [(0.0, 0.0)] * len(_SIDES)  # of the feet, from the centre of mass, before the first step
        ratio = robot.mass / (robot.mass + config.slider_mass)
        self._pendulum = Pendulum(over_blocks(self.height, blocks, config.planner.ramp), robot.gravity, ratio)
        self._planner = VelocityReversalPlanner(config.planner, self._pendulum)
        self.observer = PendulumObserver(self.height, rate, config.observer, ratio * robot.gravity)
        self.observer.reset(x, y, 0.0, 0.0)

    def stand(self, com: Sequence[float], feet: Sequence[Foot]) -> None:
        """Keep where the feet stand from the centre of mass: ``placement`` "fixed" will put them there again."""
        self._stood = [(foot.x - com[0], foot.y - com[1]) for foot in feet]

    def launch(self, y: float, stance_y: float) -> tuple[float, float]:
        """Acceleration [m/s²] and duration [s] of the centre of mass at ``y`` towards the first stance foot. After that
        its velocity reverses on that foot in the planner's own time t'_y."""
        a = self._config.lean
        if a == 0.0:
            return 0.0, 0.0
        distance = abs(stance_y - y)
        omega = math.sqrt(self._gravity / self.height)
        k = omega * math.tanh(omega * self._config.planner.reversal_time_y)
        duration = (-1.0 + math.sqrt(1.0 + 2.0 * k * k * distance / a)) / k  # a t = k (distance − a t²/2)
        return math.copysign(a, stance_y - y), duration

    def falling(self, offset: float) -> float:
        """Acceleration [m/s²] of the pendulum ``offset`` [m] from its foot, on level ground."""
        return self._gravity / self.height * offset

    def height_reference(self, stance: Foot) -> tuple[float, float, float]:
        """z, z', z'' that hold the centre of mass on the planner's surface as it falls along x:
        z'' = z_x x'' + z_xx x'²."""
        observer = self.observer
        z, zx, _, zxx, _, _ = self._pendulum.surface(observer.x, observer.y)
        ax, _ = self._pendulum.acceleration(PendulumState(observer.x, stance.y, observer.vx, 0.0), stance)
        return z, zx * observer.vx, zx * ax + zxx * observer.vx**2

    # --- planning ---------------------------------------------------------------------------------------------

    def plan(self, now: float, to_touchdown: float, swing: int, feet: Sequence[Foot], com: Sequence[float]) -> Plan:
        """Where foot ``swing`` shall land, ``to_touchdown`` [s] from ``now``, while the other one stands."""
        config, timing, observer = self._config, self._config.timing, self.observer
        # the weight goes over little by little: in the mean in the middle of it
        to_switch = to_touchdown + (timing.loading + timing.dual_support + timing.transition) / 2
        state = PendulumState(observer.x, observer.y, observer.vx, observer.vy)
        if config.placement == "fixed":
            dx, dy = self._stood[swing]
            foot = Foot(com[0] + dx, com[1] + dy, self._ground)
            return Plan(foot, foot[:2], False, state, to_switch, 0.0, 0, True)
        planner, stance, goal = config.planner, feet[1 - swing], self._goal(now + to_switch)
        ground = self.levels[1 - swing]
        for _ in range(2):  # once more where the ground is not as high as under the stance foot
            plan = self._planner.plan(state, stance, _SIDES[swing], to_switch, goal, ground)
            x = clear_of_edges(self._blocks, plan.foot.x, planner.edge_clearance)
            believed, ground = ground, self._ground + ground_height(self._blocks, x)
            if ground == believed:
                break
        return plan._replace(foot=Foot(x, plan.foot.y if planner.lateral else feet[swing].y, ground))

    def step_up(self, now: float, swing: int, feet: Sequence[Foot], com: Sequence[float]) -> float:
        """How much higher foot ``swing`` will land than it stood, as far as can be told when it lifts [m]."""
        if self.level:
            return 0.0
        timing = self._config.timing
        there = self.plan(now, timing.lifting + timing.landing, swing, feet, com).foot.z
        return max(0.0, there - self.levels[swing])

    def landed(self, foot: int, height: float) -> None:
        """``foot`` stands, at ``height`` [m] by the joints: on the known ground next to it, for it may have missed an
        edge."""
        levels = [self._ground, *(self._ground + block.height for block in self._blocks)]
        self.levels[foot] = min(levels, key=lambda level: abs(level - height))

    def _goal(self, time: float) -> tuple[float, float]:
        """x, y [m] that the planner is pulled to, at ``time``."""
        config, (x, y) = self._config, self.middle
        gone = time - config.start
        return x + config.goal_velocity_x * gone, y + config.goal_velocity_y * gone

    # --- state ------------------------------------------------------------------------------------------------

    def snapshot(self) -> Any:
        return list(self.levels), self._stood, self.observer.snapshot()

    def restore(self, state: Any) -> None:
        levels, self._stood, own = state
        self.levels[:] = levels
        self.observer.restore(own)
