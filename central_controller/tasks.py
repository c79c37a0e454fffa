"""Feedback of the task coordinates: PID to accelerations."""

from __future__ import annotations

from typing import Any

import numpy as np

from central_controller.config import TaskSetConfig

_INTEGRAL_LIMIT = 3.0  # m/s² or rad/s² that the integral may command


class TaskFeedback:
    """u = a_ref + kd (v_ref − v) + kp (x_ref − x) + ki ∫(x_ref − x) dt for [CoM_x, CoM_z, pitch, roll]."""

    def __init__(self, config: TaskSetConfig, dt: float) -> None:
        gains = (config.com_x, config.com_z, config.pitch, config.roll)
        self._kp = np.array([g.kp for g in gains])
        self._kd = np.array([g.kd for g in gains])
        self._ki_dt = np.array([g.ki for g in gains]) * dt
        self._integral = np.zeros(4)

    def acceleration(
        self, reference: np.ndarray, value: np.ndarray, velocity: np.ndarray, integrate: bool
    ) -> np.ndarray:
        """Commanded accelerations (4,). ``reference``: position, velocity and acceleration (3, 4)."""
        error = reference[0] - value
        if integrate:
            self._integral = np.clip(self._integral + self._ki_dt * error, -_INTEGRAL_LIMIT, _INTEGRAL_LIMIT)
        return reference[2] + self._kd * (reference[1] - velocity) + self._kp * error + self._integral

    def snapshot(self) -> Any:
        return self._integral.copy()

    def restore(self, state: Any) -> None:
        self._integral = state.copy()
