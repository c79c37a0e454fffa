"""What a behaviour has in common with the controller's node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import casadi as ca
import numpy as np

from central_controller.config import ControllerConfig
from central_controller.model import RobotModel
from robots.description import Robot

Compile = Callable[[ca.Function], ca.Function]


class Phase(IntEnum):
    """What the controller is doing, in order."""

    OFF = 0  # waiting for the first measurements
    ENABLING = 1  # walking the drives through their states; they hold the joints while the robot hangs still
    RAMP = 2  # from the torques that held the joints to those of the control law
    ON = 3


@dataclass(frozen=True)
class Workspace:
    """What node and behaviour share: float64 arrays that stay where they are, n joints.

    Measurements: ``counts`` (3 n: positions, velocities, torques as the drives send them), ``gyro`` (3) [rad/s],
    ``force`` (3) [m/s²], ``contacts`` (feet, 1 where the ground is touched). Estimate: ``q``, ``v`` in the coordinates
    of ``model``.
    """

    robot: Robot
    config: ControllerConfig
    model: RobotModel
    counts: np.ndarray
    gyro: np.ndarray
    force: np.ndarray
    contacts: np.ndarray
    q: np.ndarray
    v: np.ndarray


class Behaviour(Protocol):
    """One way to move. Called every servo tick, after ``q`` and ``v`` have been estimated and the model computed.

    ``memory`` begins with what the estimate remembers (``central_controller.law.ESTIMATE``); ``memory_next`` is what
    the next tick shall find there. ``telemetry`` has the meanings of ``fields``; the set-points of the joints are
    ``torque`` [N m] and what is in ``setpoints``.
    """

    def __init__(self, workspace: Workspace, compile: Compile) -> None: ...

    @staticmethod
    def fields(robot: Robot) -> list[str]:
        """Names of ``telemetry``, in order."""

    telemetry: np.ndarray
    torque: np.ndarray
    memory: np.ndarray
    memory_next: np.ndarray
    setpoints: Setpoints

    def act(self, phase: Phase, now_ns: int, since_ns: int) -> None:
        """Compute the set-points of this tick of ``phase``, entered at ``since_ns``."""

    def take_over(self) -> None:
        """The joints' own hold ends with this tick: from now on the set-points count."""

    def snapshot(self) -> Any: ...
    def restore(self, state: Any) -> None: ...


class Setpoints:
    """What the drives are told beside a torque, a list each, by joint."""

    def __init__(self, joints: int, mode: int, gain_set: int) -> None:
        self.modes = [mode] * joints
        self.gain_sets = [gain_set] * joints
        self.positions: list[float] | None = None  # rad; None: where the joints are
        self.velocities = [0.0] * joints  # rad/s


def ramp(length: float, rate: float, since_ns: int) -> float:
    """Share, 0 to 1, of torques that grow over ``length`` [s], ``since_ns`` after they began."""
    return min(since_ns * 1e-9 / max(length, 1.0 / rate), 1.0)
