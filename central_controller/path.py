"""References of the centre of mass over time, as CasADi expressions."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from central_controller.config import PathConfig

_RAMP_S = 2.0  # the amplitude grows from the centre over this time


def path_constants(config: PathConfig) -> np.ndarray:
    """Radii in x and z [m] and angular frequency [rad/s] of the ellipse; to hold is an ellipse without size."""
    held = config.kind == "hold"
    return np.array([0.0 if held else config.semi_x, 0.0 if held else config.semi_z, 2.0 * math.pi / config.period])


def smooth_step(t: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Quintic from 0 to 1 over t in [0, 1]: value, first and second derivative; constant outside."""
    t = ca.fmax(0.0, ca.fmin(1.0, t))
    return (
        t**3 * (10.0 - 15.0 * t + 6.0 * t * t),
        30.0 * t * t * (1.0 - t) ** 2,
        60.0 * t * (1.0 - t) * (1.0 - 2.0 * t),
    )


def offset(constants: ca.SX, t: ca.SX) -> ca.SX:
    """Offset from the starting CoM ``t`` [s] after the path's start: rows position, velocity, acceleration; columns
    x, z. Nothing before the start."""
    omega = constants[2]
    a, da, dda = smooth_step(t / _RAMP_S)
    da, dda = da / _RAMP_S, dda / _RAMP_S**2
    sine, cosine = ca.sin(omega * t), ca.cos(omega * t)
    columns = []
    for radius, value, slope in ((constants[0], cosine, -sine), (constants[1], sine, cosine)):
        rate, curvature = slope * omega, -value * omega**2
        columns.append(radius * ca.vertcat(
            a * value,
            da * value + a * rate,
            dda * value + 2.0 * da * rate + a * curvature,
        ))  # fmt: skip
    return ca.horzcat(*columns)
