"""The unscented foot filter: Kim 2018 §6.2.1, third."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from central_controller.binding import Bound
from central_controller.estimation.chain import Chain
from central_controller.estimation.foot_models import FootNoise, Measurements, dynamics_with_foot, initial_variances
from central_controller.estimation.kalman import identity


class UnscentedFilter:
    """The same state and models as EndEffectorFilter's, through sigma points (filterpy): Kim 2018 Fig. 6.4."""

    fields: ClassVar[tuple[str, ...]] = ("q", "dq", "p")

    def __init__(
        self, chain: Chain, noise: FootNoise, compile: Callable[[ca.Function], ca.Function] = identity
    ) -> None:
        self._chain, self._noise, self._joints = chain, noise, chain.joints
        self._measurements = Measurements(chain.joints, noise)
        dt = ca.SX.sym("dt")
        x, f, Q = dynamics_with_foot(chain, noise, dt)
        n = x.numel()
        step = ca.Function("unscented", [x, chain.torque, dt], [f], ["x", "u", "dt"], ["x_next"])
        self._x, self._u, self._dt, self._next = np.zeros(n), np.zeros(chain.joints), np.zeros(1), np.zeros(n)
        self._step = Bound(compile(step), {"x": self._x, "u": self._u, "dt": self._dt}, {"x_next": self._next})
        self._process = ca.Function("process", [dt], [Q])
        points = MerweScaledSigmaPoints(n, alpha=0.5, beta=2.0, kappa=3.0 - n)
        self._ukf = UnscentedKalmanFilter(n, n, 0.0, hx=_itself, fx=self._transition, points=points)

    def _transition(self, x: np.ndarray, dt: float) -> np.ndarray:
        self._x[:] = x
        self._step()
        return self._next

    @property
    def state(self) -> np.ndarray:
        return self._ukf.x

    @property
    def covariance(self) -> np.ndarray:
        return self._ukf.P

    @property
    def position(self) -> np.ndarray:
        return self._ukf.x[-2:].copy()

    @property
    def position_covariance(self) -> np.ndarray:
        return self._ukf.P[-2:, -2:].copy()

    @property
    def nis(self) -> float:
        return float(self._ukf.mahalanobis) ** 2

    def start(self, encoders: np.ndarray) -> None:
        self._ukf.x = np.concatenate([encoders, self._chain.forward(encoders[: self._joints])])
        self._ukf.P = np.diag(initial_variances(self._joints, self._noise))

    def predict(self, dt: float, torque: np.ndarray) -> None:
        self._u[:] = torque
        if dt != self._dt[0]:
            self._dt[0] = dt
            self._ukf.Q = np.asarray(self._process(dt))
        self._ukf.predict(dt)

    def update(self, encoders: np.ndarray, mocap: np.ndarray | None) -> None:
        variances = self._measurements.take(encoders, mocap)
        self._ukf.update(self._measurements.z, R=np.diag(variances))

    def snapshot(self) -> Any:
        ukf = self._ukf
        return ukf.x.copy(), ukf.P.copy(), ukf.sigmas_f.copy(), ukf.Q.copy(), self._dt[0]

    def restore(self, state: Any) -> None:
        ukf = self._ukf
        ukf.x, ukf.P, ukf.sigmas_f, ukf.Q = (part.copy() for part in state[:-1])
        self._dt[0] = state[-1]


def _itself(x: np.ndarray) -> np.ndarray:
    return x
