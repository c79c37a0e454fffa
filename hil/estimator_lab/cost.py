"""What the estimators cost of a servo tick of Hume, on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from central_controller.estimation.foot_light import light_filter
from central_controller.estimation.foot_models import FootNoise
from central_controller.estimation.kalman import UNKNOWN
from central_controller.estimation.orientation_ekf import OrientationFilter, OrientationNoise
from central_controller.estimation.pendulum_observer import PendulumNoise, PendulumObserver
from hil.compiled import compile_function

LIMIT = 100e-6  # s: "only 0.1ms is allowed for estimators" (Kim 2018 §6.2.2)
_DT = 1 / 1500.0


def tick_costs(ticks: int = 2000) -> dict[str, float]:
    """Median time [s] of prediction and correction of each estimator that runs in the tick, at Hume's sizes."""
    quaternion, rate = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.1, 0.2, 0.3])
    orientation = OrientationFilter(1 / _DT, OrientationNoise(), compile_function)
    foot = light_filter(12, 3, FootNoise(), compile_function)
    foot.covariance[:] = np.eye(15) * 1e-3
    J, z, variances = np.linspace(-1, 1, 36), np.zeros(15), np.full(15, 1e-4)
    variances[12:] = UNKNOWN
    pendulum = PendulumObserver(0.85, 1 / _DT, PendulumNoise())

    def turn() -> None:
        orientation.predict(rate, True)
        orientation.correct(quaternion, True)

    def place() -> None:
        foot.predict(_DT, J)
        foot.correct(z, variances)

    def fall() -> None:
        pendulum.predict(0.0, 0.1)
        pendulum.correct(0.0, 0.0, 0.1, 0.1)

    tasks = {"orientation EKF": turn, "foot position, light filter of 15 states": place, "pendulum observer": fall}
    return {name: _median(task, ticks) for name, task in tasks.items()}


def _median(task: Callable[[], None], ticks: int) -> float:
    clock, times = time.perf_counter_ns, np.zeros(ticks)
    for k in range(ticks):
        began = clock()
        task()
        times[k] = clock() - began
    return float(np.median(times[ticks // 4 :])) * 1e-9
