"""The orientation filter of Kim 2018 §6.1 on a body that sways over a flat foot, which at times rocks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from central_controller.estimation.orientation_ekf import OrientationFilter, OrientationNoise
from hil.compiled import compile_function
from hil.estimator_lab.consistency import Consistency, consistency, normalised
from hil.streams import streams

RATE = 500.0  # Hz
GYRO_BIAS = 0.02  # rad/s, on each axis
SLOPE = 5e-3  # rad, of a ground that is not as level as assumed
_AMPLITUDE, _FREQUENCY = (0.1, 0.1, 0.2), (0.5, 0.8, 0.3)  # rad, Hz of roll, pitch, yaw
_ROCKS, _PERIOD, _ANGLE = 0.4, 2.0, 0.15  # s, s, rad: every period the foot pitches that far and back
_SETTLED = 1.0  # s


class Score(NamedTuple):
    """Error of the orientation [rad] and of the gyro's bias at the end [rad/s], RMS and largest; consistency of the
    orientation (3 degrees of freedom) and of the innovations."""

    rms: float
    largest: float
    bias: float
    nees: Consistency
    nis: Consistency


def score(
    seeds: range, duration: float, noise: OrientationNoise, foot_sensors: bool = True, slope: float = 0.0
) -> Score:
    """Over a run per seed. ``foot_sensors``: the filter is told when the foot is not flat, else it takes it for flat at
    all times; ``slope`` [rad]: roll of the ground."""
    runs = [_run(seed, round(duration * RATE), noise, foot_sensors, slope) for seed in seeds]
    errors, nees, nis, freedoms = (np.array([run[i] for run in runs]) for i in range(4))
    return Score(
        float(np.sqrt(np.mean(errors**2))), float(errors.max()),
        float(np.sqrt(np.mean(np.concatenate([run[4] for run in runs]) ** 2))),
        consistency(nees, np.full_like(nees, 3.0)), consistency(nis, freedoms),
    )  # fmt: skip


def _run(seed: int, ticks: int, noise: OrientationNoise, foot_sensors: bool, slope: float) -> tuple[np.ndarray, ...]:
    """Error angle, NEES and NIS with its degrees of freedom at each sample after the start; error of the bias."""
    gyro, joints = (streams(seed)(f"orientation.{name}") for name in ("gyro", "joints"))
    estimator = OrientationFilter(RATE, noise, compile_function)
    density, dt = noise.gyro * math.sqrt(RATE), 1.0 / RATE
    base, settled = _base(0.0), round(_SETTLED * RATE)
    estimator.reset(_quaternion(base), _quaternion(base))
    rows = np.zeros((ticks, 4))
    for k in range(1, ticks + 1):
        before, base = base, _base(k * dt)
        rate = pin.log3(before.T @ base) * RATE
        rock = (k * dt) % _PERIOD - (_PERIOD - _ROCKS)
        pitch = _ANGLE * math.sin(math.pi * rock / _ROCKS) if rock > 0 else 0.0
        flat = rock <= 0 or not foot_sensors
        foot = pin.rpy.rpyToMatrix(slope, pitch, 0.0)
        estimator.predict(rate + GYRO_BIAS + density * gyro.normal(3), flat)
        estimator.correct(_quaternion(foot.T @ base @ pin.exp3(noise.kinematics * joints.normal(3))), flat)
        error = pin.log3(base @ pin.Quaternion(estimator.orientation).toRotationMatrix().T)
        rows[k - 1] = (
            np.linalg.norm(error), normalised(error, estimator.covariance[:3, :3]), estimator.nis, 6.0 if flat else 3.0
        )  # fmt: skip
    return *rows[settled:].T, estimator.bias + GYRO_BIAS


def _base(t: float) -> np.ndarray:
    angles = [a * math.sin(2 * math.pi * f * t) for a, f in zip(_AMPLITUDE, _FREQUENCY, strict=True)]
    return pin.rpy.rpyToMatrix(*angles)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    return pin.Quaternion(rotation).coeffs()
