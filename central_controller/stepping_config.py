"""Configuration of stepping: timing, gains, planner, observer. Defaults: Kim 2018 Tables 7.1 and 7.2."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from central_controller.estimation.pendulum_observer import PendulumNoise
from central_controller.planning.config import PlannerConfig, StepTiming, SwingConfig
from central_controller.task_gains import TaskGains
from robots.quantities import Config, Gain, Kilograms, MetresPerSecond, Radians, Seconds


class DoubleSupportGains(Config):
    """[CoM_y, CoM_z, yaw, pitch, roll]. CoM_y is moved before the first step only; with kp 150 and kd 20 the robot
    would not stand with 4 ms more delay."""

    com_y: TaskGains = TaskGains(kp=60.0, kd=10.0)
    com_z: TaskGains = TaskGains(kp=270.0, kd=10.0, ki=20.0)
    yaw: TaskGains = TaskGains(kp=100.0, kd=10.0)
    pitch: TaskGains = TaskGains(kp=200.0, kd=15.0, ki=20.0)
    roll: TaskGains = TaskGains(kp=210.0, kd=10.0, ki=35.0)


class SingleSupportGains(Config):
    """[CoM_z, pitch, roll, foot x, y, z]."""

    com_z: TaskGains = TaskGains(kp=270.0, kd=10.0, ki=20.0)
    pitch: TaskGains = TaskGains(kp=200.0, kd=15.0, ki=20.0)
    roll: TaskGains = TaskGains(kp=210.0, kd=10.0, ki=35.0)
    foot_x: TaskGains = TaskGains(kp=220.0, kd=35.0, ki=35.0)
    foot_y: TaskGains = TaskGains(kp=237.0, kd=40.0, ki=40.0)
    foot_z: TaskGains = TaskGains(kp=400.0, kd=60.0, ki=35.0)


class SteppingGains(Config):
    """Task gains by support (Kim 2018 Table 7.1)."""

    double_support: DoubleSupportGains = DoubleSupportGains()
    single_support: SingleSupportGains = SingleSupportGains()

    def double(self, dt: float) -> np.ndarray:
        """kp, kd and ki times the tick's length (3, 8), by ``stepping_law.COORDINATES``."""
        g = self.double_support
        return _table(dt, g.com_y, g.com_z, g.yaw, g.pitch, g.roll, *[TaskGains(kp=0.0, kd=0.0)] * 3)

    def single(self, dt: float) -> np.ndarray:
        """The same in single support."""
        g, none = self.single_support, TaskGains(kp=0.0, kd=0.0)
        return _table(dt, none, g.com_z, none, g.pitch, g.roll, g.foot_x, g.foot_y, g.foot_z)


def _table(dt: float, *gains: TaskGains) -> np.ndarray:
    return np.array([(g.kp, g.kd, g.ki * dt) for g in gains]).T.copy(order="F")


_FEET = {"right": 0, "left": 1}
Foot = Annotated[Literal[0, 1], BeforeValidator(lambda value: _FEET.get(value, value))]


class StepConfig(Config):
    """Stepping in place or towards a goal."""

    start: Seconds = 1.2  # from the start of the run: the robot stands on its own by then
    first: Foot = 0  # the foot that lifts first: "right" or "left"
    transition: bool = True  # of forces, in and out (2.19); false: single support begins and ends at once
    # "fixed": each foot lands where it stood before the first step, as seen from the centre of mass (Kim 2018 §2.2.1)
    placement: Literal["planned", "fixed"] = "planned"
    # joints that turn out of the sagittal plane are held where they are, by their drives, and not by whole-body control
    hold_abduction: bool = False
    slider_mass: Kilograms = 0.0  # m_s of (7.5), that planner and observer count on
    goal_velocity_x: MetresPerSecond = 0.0  # of the planner's goal, which begins to move with the first step
    goal_velocity_y: MetresPerSecond = 0.0
    lean: Gain = 0.8  # m/s² with which the centre of mass is set in motion before the first step; 0: not at all
    # Yaw is turned back by a couple of horizontal forces at the feet, which friction bounds: 0.1 rad times kp of 100
    # asks of Hume, 0.3 kg m² about the vertical, 3 N m: 20 N at feet 15 cm apart, a third of what half its weight can.
    yaw_error_limit: Annotated[Radians, Field(gt=0)] = 0.1
    timing: StepTiming = StepTiming()
    gains: SteppingGains = SteppingGains()
    planner: PlannerConfig = PlannerConfig()
    swing: SwingConfig = SwingConfig()
    observer: PendulumNoise = PendulumNoise()
