"""Where the torso is and how it moves, from the IMU, the joints, and feet that stand.

Orientation by a complementary filter: the gyro is integrated, the accelerometer pulls roll and pitch, the line between
the standing feet pulls yaw. Position and velocity follow from both feet standing still. The origin is the midpoint of
the feet's centres. The gyro's zero is the mean of its samples while the robot hangs still.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np

from central_controller.config import ControllerConfig
from central_controller.rotations import compose, exponential, rotation_matrix

_STILL_AFTER = 0.3  # s from the first sample: the robot has come to rest on the hoist
_YAW_TIME_CONSTANT = 0.5  # s, of the correction by the line between the feet
_FREE_FALL = 1.0  # m/s²: a smaller specific force does not tell where down is


def filter_constants(config: ControllerConfig) -> np.ndarray:
    """What a tick takes of each source: its length [s], then the shares of the accelerometer's correction, of the
    feet's correction of yaw, of a new joint velocity and of a new internal force."""
    dt = 1.0 / config.rate
    blends = (-math.expm1(-2.0 * math.pi * f * dt) for f in (config.velocity_cutoff, config.internal_force.cutoff))
    return np.array([dt, dt / config.orientation_time_constant, dt / _YAW_TIME_CONSTANT, *blends])


def turned(quaternion: ca.SX, rate: ca.SX, force: ca.SX, constants: ca.SX) -> ca.SX:
    """Orientation one tick later, from the angular velocity ``rate`` [rad/s] and the specific force [m/s²]."""
    up = rotation_matrix(quaternion)[2, :].T  # world's up in the base's frame
    size = ca.sqrt(ca.dot(force, force))
    correction = (size > _FREE_FALL) * ca.cross(force, up) / ca.fmax(size, _FREE_FALL)
    return compose(quaternion, exponential(rate * constants[0] + constants[1] * correction))


def yaw_corrected(quaternion: ca.SX, feet: ca.SX, heading: ca.SX, standing: ca.SX, constants: ca.SX) -> tuple:
    """Orientation for the next tick, and the heading [rad] of the line between the feet (3, 2) to hold it by: while
    ``standing`` is 0, the present one."""
    line = feet[:, 0] - feet[:, 1]
    present = ca.atan2(line[1], line[0])
    kept = ca.if_else(standing, heading, present)
    error = ca.remainder(kept - present, 2.0 * math.pi)
    return compose(exponential(ca.vertcat(0.0, 0.0, constants[2] * error)), quaternion), kept


class Hanging:
    """What can be learnt while the robot hangs still: the gyro's ``zero`` [rad/s] and the orientation, a
    ``quaternion`` without yaw."""

    def __init__(self, rate: float) -> None:
        self.zero, self.quaternion = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        self._still_after = round(_STILL_AFTER * rate)  # samples
        self._sums = np.zeros(6)  # gyro and specific force
        self._seen = 0  # samples
        self._count = 0  # of these, those that count

    def take(self, gyro: np.ndarray, force: np.ndarray) -> None:
        """Take a sample of angular velocity [rad/s] and specific force [m/s²]."""
        self._seen += 1
        if self._seen <= self._still_after:  # what came so far was still swinging
            self._sums[:] = 0.0
            self._count = 0
        self._sums[:3] += gyro
        self._sums[3:] += force
        self._count += 1
        self.zero[:] = self._sums[:3] / self._count
        x, y, z = self._sums[3:].tolist()  # along the world's up, of any length
        pitch, roll = math.atan2(-x, math.hypot(y, z)) / 2, math.atan2(y, z) / 2
        sp, cp, sr, cr = math.sin(pitch), math.cos(pitch), math.sin(roll), math.cos(roll)
        self.quaternion[:] = cp * sr, sp * cr, -sp * sr, cp * cr

    def snapshot(self) -> Any:
        return self.zero.copy(), self.quaternion.copy(), self._sums.copy(), self._seen, self._count

    def restore(self, state: Any) -> None:
        self.zero[:], self.quaternion[:], self._sums[:], self._seen, self._count = state
