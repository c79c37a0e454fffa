"""The foot filters that are extended Kalman filters with the chain's dynamics: Kim 2018 §6.2.1, first and second."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import casadi as ca
import numpy as np

from central_controller.estimation.chain import Chain
from central_controller.estimation.foot_models import (
    ExtendedFootFilter,
    FootNoise,
    accelerated,
    dynamics,
    dynamics_with_foot,
    initial_variances,
)
from central_controller.estimation.kalman import ExtendedKalmanFilter, identity


class ConfigurationFilter(ExtendedFootFilter):
    """EKF on the configuration: Kim 2018 (6.26)–(6.30). The foot is where its angles put it."""

    fields: ClassVar[tuple[str, ...]] = ("q", "dq")

    def __init__(
        self, chain: Chain, noise: FootNoise, compile: Callable[[ca.Function], ca.Function] = identity
    ) -> None:
        n, dt = chain.joints, ca.SX.sym("dt")
        x, f = dynamics(chain, dt)
        Q = accelerated(noise.acceleration, n, dt, ca.SX(2 * n, 2 * n))
        h = ca.vertcat(x, chain.position)
        super().__init__(ExtendedKalmanFilter("configuration", x, chain.torque, dt, f, h, Q, compile), n, noise)
        self._chain = chain

    @property
    def position(self) -> np.ndarray:
        return self._chain.forward(self.state[: self._joints])

    @property
    def position_covariance(self) -> np.ndarray:
        n = self._joints
        J = self._chain.jacobian_at(self.state[:n])
        return J @ self.covariance[:n, :n] @ J.T

    def start(self, encoders: np.ndarray) -> None:
        self.state[:] = encoders
        self.covariance[:] = np.diag(initial_variances(self._joints, self._noise)[:-2])

    def predict(self, dt: float, torque: np.ndarray) -> None:
        self._ekf.predict(dt, torque)

    def update(self, encoders: np.ndarray, mocap: np.ndarray | None) -> None:
        variances = self._measurements.take(encoders, mocap)
        self._ekf.correct(self._measurements.z, variances)


class EndEffectorFilter(ExtendedFootFilter):
    """EKF on configuration and end effector: Kim 2018 (6.31)–(6.34)."""

    fields: ClassVar[tuple[str, ...]] = ("q", "dq", "p")

    def __init__(
        self, chain: Chain, noise: FootNoise, compile: Callable[[ca.Function], ca.Function] = identity
    ) -> None:
        dt = ca.SX.sym("dt")
        x, f, Q = dynamics_with_foot(chain, noise, dt)
        super().__init__(
            ExtendedKalmanFilter("end_effector", x, chain.torque, dt, f, x, Q, compile), chain.joints, noise
        )
        self._chain = chain

    @property
    def position(self) -> np.ndarray:
        return self.state[-2:].copy()

    @property
    def position_covariance(self) -> np.ndarray:
        return self.covariance[-2:, -2:].copy()

    def start(self, encoders: np.ndarray) -> None:
        self.state[:-2] = encoders
        self.state[-2:] = self._chain.forward(encoders[: self._joints])
        self.covariance[:] = np.diag(initial_variances(self._joints, self._noise))

    def predict(self, dt: float, torque: np.ndarray) -> None:
        self._ekf.predict(dt, torque)

    def update(self, encoders: np.ndarray, mocap: np.ndarray | None) -> None:
        variances = self._measurements.take(encoders, mocap)
        self._ekf.correct(self._measurements.z, variances)
