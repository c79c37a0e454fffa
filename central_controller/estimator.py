"""Where the torso is and how it moves, from the IMU, the joints, and feet that stand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin

from central_controller.config import ControllerConfig
from central_controller.model import RobotModel

_STILL_AFTER = 0.3  # s from the first sample: the robot has come to rest on the hoist
_YAW_TIME_CONSTANT = 0.5  # s, of the correction by the line between the feet


class BaseEstimator:
    """Orientation by a complementary filter: the gyro is integrated, the accelerometer pulls roll and pitch, the line
    between the standing feet pulls yaw. Position and velocity follow from both feet standing still. The origin is
    the midpoint of the feet's centres.

    The gyro's zero is the mean of its samples while the robot hangs still.
    """

    def __init__(self, model: RobotModel, config: ControllerConfig) -> None:
        self._model = model
        self._dt = 1.0 / config.rate
        self._pull = self._dt / config.orientation_time_constant
        self._yaw_pull = self._dt / _YAW_TIME_CONSTANT
        self._blend = 1.0 - math.exp(-2.0 * math.pi * config.velocity_cutoff * self._dt)
        self.rotation = np.eye(3)  # base to world
        self.q, self.v = np.zeros(model.nq), np.zeros(model.nv)
        self._still_after = round(_STILL_AFTER * config.rate)  # samples
        self._bias = np.zeros(3)  # of the gyro, rad/s
        self._sums = np.zeros(6)  # gyro and specific force while hanging
        self._seen = 0  # samples while hanging
        self._count = 0  # of these, those that count
        self._line: float | None = None  # heading of the line between the feet
        self._dq = np.zeros(model.nv - 6)

    def hang(self, gyro: np.ndarray, force: np.ndarray) -> None:
        """Take a sample while the robot hangs still: zero of the gyro, and where down is."""
        self._seen += 1
        if self._seen <= self._still_after:  # what came so far was still swinging
            self._sums[:] = 0.0
            self._count = 0
        self._sums[:3] += gyro
        self._sums[3:] += force
        self._count += 1
        self._bias = self._sums[:3] / self._count
        up = self._sums[3:] / math.sqrt(self._sums[3:] @ self._sums[3:])
        pitch, roll = math.asin(-up[0]), math.atan2(up[1], up[2])
        self.rotation = pin.rpy.rpyToMatrix(roll, pitch, 0.0)

    def turn(self, gyro: np.ndarray, force: np.ndarray) -> None:
        """Integrate one sample of the IMU over one tick."""
        rate = gyro - self._bias
        up_body = self.rotation[2]  # world's up in the base's frame
        size = math.sqrt(force @ force)
        if size > 1.0:
            fx, fy, fz = (force / size).tolist()
            ux, uy, uz = up_body.tolist()
            correction = np.array([fy * uz - fz * uy, fz * ux - fx * uz, fx * uy - fy * ux])  # force × up
            step = rate * self._dt + self._pull * correction
        else:
            step = rate * self._dt
        self.rotation = self.rotation @ pin.exp3(step)
        self.v[3:6] = rate

    def place(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """Base state from joint positions [rad] and velocities [rad/s]; fills ``q`` and ``v`` for the model."""
        self._dq += self._blend * (velocity - self._dq)
        q, v = self.q, self.v
        q[7:], v[6:] = position, self._dq
        q[:3] = 0.0
        v[:3] = 0.0
        q[3:7] = pin.Quaternion(self.rotation).coeffs()
        feet, motion = self._model.feet_motion(q, v)
        heading = math.atan2(feet[0, 1] - feet[1, 1], feet[0, 0] - feet[1, 0])
        if self._line is None:
            self._line = heading
        error = math.remainder(self._line - heading, 2.0 * math.pi)
        self.rotation = pin.exp3(np.array([0.0, 0.0, self._yaw_pull * error])) @ self.rotation
        q[:3] = -0.5 * (feet[0] + feet[1])
        v[:3] = -self.rotation.T @ (0.5 * (motion[0] + motion[1]))

    def snapshot(self) -> dict[str, Any]:
        return {
            "rotation": self.rotation.copy(), "q": self.q.copy(), "v": self.v.copy(), "sums": self._sums.copy(),
            "count": (self._seen, self._count), "line": self._line, "dq": self._dq.copy(), "bias": self._bias.copy(),
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        self.rotation = state["rotation"].copy()
        self.q[:], self.v[:], self._sums[:], self._dq[:] = state["q"], state["v"], state["sums"], state["dq"]
        (self._seen, self._count), self._line = state["count"], state["line"]
        self._bias = state["bias"].copy()
