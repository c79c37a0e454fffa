"""What the foot filters of Kim 2018 §6.2 share: their interface, noises, measurements and models of the motion."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import casadi as ca
import numpy as np

from central_controller.estimation.chain import Chain
from central_controller.estimation.kalman import UNKNOWN, ExtendedKalmanFilter
from robots.quantities import Config, Gain, Metres, Radians, RadiansPerSecond


class FootNoise(Config):
    """Noises of the filters: 1σ per sample of what is measured; densities per √Hz of what disturbs. Defaults are for
    the two-joint chain of Kim 2018 §6.2.1, which states none."""

    encoder: Radians = 0.002
    rate: RadiansPerSecond = 0.02
    mocap: Metres = 0.001
    # rad/s²/√Hz, of joints about the model's dynamics: gravity at angles 0.05 rad off is 1.5 rad/s², for 0.3 s
    acceleration: Gain = 1.0
    # m/s/√Hz, of the foot beside J q̇: 5 % of 0.7 m/s for 0.3 s, since links bend and encoders are off
    slip: Gain = 0.02
    free_acceleration: Gain = 10.0  # rad/s²/√Hz, of joints whose dynamics nobody models
    initial_rate: RadiansPerSecond = 0.5
    initial_foot: Metres = 0.03


class FootFilter(Protocol):
    """``position`` (2,) [m] of the foot with its ``position_covariance``, and the whole ``state`` (of the ``fields`` q,
    dq and p) with its ``covariance``, are the estimate after each call; ``nis`` is that of the last update."""

    fields: ClassVar[tuple[str, ...]]

    @property
    def state(self) -> np.ndarray: ...

    @property
    def covariance(self) -> np.ndarray: ...

    @property
    def position(self) -> np.ndarray: ...

    @property
    def position_covariance(self) -> np.ndarray: ...

    @property
    def nis(self) -> float: ...

    def start(self, encoders: np.ndarray) -> None:
        """Begin at the ``encoders``: joint angles [rad], then rates [rad/s]."""

    def predict(self, dt: float, torque: np.ndarray) -> None:
        """Go on by ``dt`` [s] under the joint torques [N m]."""

    def update(self, encoders: np.ndarray, mocap: np.ndarray | None) -> None:
        """Take angles and rates, and the foot's position [m] if motion capture has a new one."""

    def snapshot(self) -> Any: ...

    def restore(self, state: Any) -> None: ...


class Measurements:
    """Variances of [encoders, mocap], with the on-line adjustment."""

    def __init__(self, joints: int, noise: FootNoise) -> None:
        self.seen = np.array([noise.encoder**2] * joints + [noise.rate**2] * joints + [noise.mocap**2] * 2)
        self.occluded = self.seen.copy()
        self.occluded[-2:] = UNKNOWN
        self.z = np.zeros(len(self.seen))

    def take(self, encoders: np.ndarray, mocap: np.ndarray | None) -> np.ndarray:
        """The variances now; the measurements are in ``z``."""
        self.z[:-2] = encoders
        if mocap is None:
            return self.occluded
        self.z[-2:] = mocap
        return self.seen


def initial_variances(joints: int, noise: FootNoise) -> np.ndarray:
    """Variances of [q, q̇, p] at the start."""
    deviations = [noise.encoder] * joints + [noise.initial_rate] * joints + [noise.initial_foot] * 2
    return np.array(deviations) ** 2


def accelerated(density: float, joints: int, dt: Any, matrix: Any) -> Any:
    """Covariance of [q, q̇] by white acceleration of ``density`` over ``dt``, in ``matrix`` (2 joints, 2 joints)."""
    for i in range(joints):
        j = joints + i
        matrix[i, i], matrix[j, j] = density**2 * dt**3 / 3, density**2 * dt
        matrix[i, j] = matrix[j, i] = density**2 * dt**2 / 2
    return matrix


def dynamics(chain: Chain, dt: ca.SX) -> tuple[ca.SX, ca.SX]:
    """[q, q̇] and what it is after ``dt``: (6.27), and the acceleration's share of the angles. Without that, angles that
    accelerate by 20 rad/s² are off by more than what motion capture leaves uncertain."""
    change = chain.dq * dt + chain.acceleration * dt**2 / 2
    return ca.vertcat(chain.q, chain.dq), ca.vertcat(chain.q + change, chain.dq + chain.acceleration * dt)


def dynamics_with_foot(chain: Chain, noise: FootNoise, dt: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """[q, q̇, p], what it is after ``dt`` (6.32), and the covariance of what disturbs it meanwhile."""
    n, p = chain.joints, ca.SX.sym("p", 2)
    x, f = dynamics(chain, dt)
    Q = accelerated(noise.acceleration, n, dt, ca.SX(2 * n + 2, 2 * n + 2))
    Q[2 * n :, 2 * n :] = ca.SX.eye(2) * noise.slip**2 * dt
    return ca.vertcat(x, p), ca.vertcat(f, p + chain.jacobian @ (f[:n] - chain.q)), ca.densify(Q)


class ExtendedFootFilter:
    """What the extended Kalman filters share."""

    def __init__(self, ekf: ExtendedKalmanFilter, joints: int, noise: FootNoise) -> None:
        self._ekf, self._joints, self._noise = ekf, joints, noise
        self.state, self.covariance = ekf.state, ekf.covariance
        self._measurements = Measurements(joints, noise)

    @property
    def nis(self) -> float:
        return self._ekf.nis

    def snapshot(self) -> Any:
        return self._ekf.snapshot()

    def restore(self, state: Any) -> None:
        self._ekf.restore(state)
