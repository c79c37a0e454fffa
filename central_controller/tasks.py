"""Feedback of the task coordinates: PID to accelerations, as a CasADi expression."""

from __future__ import annotations

import casadi as ca
import numpy as np

from central_controller.config import TaskSetConfig

_INTEGRAL_LIMIT = 3.0  # m/s² or rad/s² that the integral may command


def task_gains(config: TaskSetConfig, dt: float) -> np.ndarray:
    """Gains (3, 4): kp, kd and ki times the tick's length, of [CoM_x, CoM_z, pitch, roll]."""
    gains = (config.com_x, config.com_z, config.pitch, config.roll)
    return np.array([(g.kp, g.kd, g.ki * dt) for g in gains]).T.copy(order="F")


def feedback(
    gains: ca.SX, reference: ca.SX, value: ca.SX, velocity: ca.SX, integral: ca.SX, integrate: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """u = a_ref + kd (v_ref − v) + kp (x_ref − x) + ki ∫(x_ref − x) dt of the task coordinates, and the new integral.

    Args:
        gains: as task_gains gives them.
        reference: rows position, velocity, acceleration (3, 4).
        value, velocity: (4,).
        integral: ki ∫(x_ref − x) dt so far (4,).
        integrate: 1, or 0 to leave the integral.
    """
    kp, kd, ki_dt = (gains[i, :].T for i in range(3))
    position_ref, velocity_ref, acceleration_ref = (reference[i, :].T for i in range(3))
    error = position_ref - value
    grown = ca.fmax(-_INTEGRAL_LIMIT, ca.fmin(_INTEGRAL_LIMIT, integral + ki_dt * error))
    integral = ca.if_else(integrate, grown, integral)
    return acceleration_ref + kd * (velocity_ref - velocity) + kp * error + integral, integral
