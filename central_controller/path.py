"""References of the centre of mass over time."""

from __future__ import annotations

import math

from central_controller.config import PathConfig

_RAMP_S = 2.0  # the amplitude grows from the centre over this time


def smooth_step(t: float) -> tuple[float, float, float]:
    """Quintic from 0 to 1 over t in [0, 1]: value, first and second derivative; constant outside."""
    if t <= 0.0:
        return 0.0, 0.0, 0.0
    if t >= 1.0:
        return 1.0, 0.0, 0.0
    return (
        t**3 * (10.0 - 15.0 * t + 6.0 * t * t),
        30.0 * t * t * (1.0 - t) ** 2,
        60.0 * t * (1.0 - t) * (1.0 - 2.0 * t),
    )


def offset(config: PathConfig, time: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Offset from the starting CoM in x and in z at ``time`` [s]: each position, velocity, acceleration."""
    t = time - config.start
    if config.kind == "hold" or t <= 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    omega = 2.0 * math.pi / config.period
    a, da, dda = smooth_step(t / _RAMP_S)
    da, dda = da / _RAMP_S, dda / _RAMP_S**2
    result = []
    for radius, value, slope in (
        (config.semi_x, math.cos(omega * t), -math.sin(omega * t)),
        (config.semi_z, math.sin(omega * t), math.cos(omega * t)),
    ):
        rate, curvature = slope * omega, -value * omega**2
        result.append((
            radius * a * value,
            radius * (da * value + a * rate),
            radius * (dda * value + 2.0 * da * rate + a * curvature),
        ))  # fmt: skip
    return result[0], result[1]
