"""The light foot filter that ran on Hume: Kim 2018 §6.2.2."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from central_controller.binding import Bound
from central_controller.estimation.chain import Chain
from central_controller.estimation.foot_models import ExtendedFootFilter, FootNoise, initial_variances
from central_controller.estimation.kalman import ExtendedKalmanFilter, identity


def light_filter(
    dofs: int, dimensions: int, noise: FootNoise, compile: Callable[[ca.Function], ca.Function] = identity
) -> ExtendedKalmanFilter:
    """The filter of Kim 2018 (6.35)–(6.37) for any robot: state and measurements [q̇ (dofs), p (dimensions)], input J
    (dimensions, dofs) of the foot, column by column. Hume's has 12 and 3."""
    rate, p = ca.SX.sym("rate", dofs), ca.SX.sym("p", dimensions)
    J, dt = ca.SX.sym("J", dimensions, dofs), ca.SX.sym("dt")
    x = ca.vertcat(rate, p)
    f = ca.vertcat(rate, p + J @ rate * dt)
    Q = ca.diag(ca.vertcat(*[noise.free_acceleration**2] * dofs, *[noise.slip**2] * dimensions)) * dt
    return ExtendedKalmanFilter("light", x, ca.vec(J), dt, f, x, Q, compile)


class LightFilter(ExtendedFootFilter):
    """The filter that ran on Hume, on a chain: the Jacobian is taken where the encoders saw the joints last."""

    fields: ClassVar[tuple[str, ...]] = ("dq", "p")

    def __init__(
        self, chain: Chain, noise: FootNoise, compile: Callable[[ca.Function], ca.Function] = identity
    ) -> None:
        n = chain.joints
        super().__init__(light_filter(n, 2, noise, compile), n, noise)
        self._chain = chain
        self._q, self._jacobian = np.zeros(n), np.zeros((2, n), order="F")
        kinematics = ca.Function("foot_jacobian", [chain.q], [chain.jacobian], ["q"], ["J"])
        self._kinematics = Bound(compile(kinematics), {"q": self._q}, {"J": self._jacobian})

    @property
    def position(self) -> np.ndarray:
        return self.state[-2:].copy()

    @property
    def position_covariance(self) -> np.ndarray:
        return self.covariance[-2:, -2:].copy()

    def start(self, encoders: np.ndarray) -> None:
        n = self._joints
        self._q[:] = encoders[:n]
        self.state[:n] = encoders[n:]
        self.state[n:] = self._chain.forward(self._q)
        self.covariance[:] = np.diag(initial_variances(n, self._noise)[n:])

    def predict(self, dt: float, torque: np.ndarray) -> None:
        self._kinematics()
        self._ekf.predict(dt, self._jacobian.reshape(-1, order="F"))

    def update(self, encoders: np.ndarray, mocap: np.ndarray | None) -> None:
        n = self._joints
        self._q[:] = encoders[:n]
        variances = self._measurements.take(encoders, mocap)
        self._ekf.correct(self._measurements.z[n:], variances[n:])

    def snapshot(self) -> Any:
        return self._q.copy(), super().snapshot()

    def restore(self, state: Any) -> None:
        self._q[:] = state[0]
        super().restore(state[1])
