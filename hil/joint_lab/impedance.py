"""Output impedance of an actuator under its torque law, and where it is not passive.

Z(jω) = −torque on the output / velocity of the output, with no torque commanded. An actuator whose Z has a negative
real part at some frequency gives energy there: some passive load exists that it makes oscillate (Colgate and Hogan
1988). Of a sampled law only the component at the frequency of the motion itself is taken: what its images add lies
beyond half the sampling rate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.joint_lab.actuator import LinearActuator
from hil.joint_lab.continuous import FEEDBACKS, Gains
from hil.joint_lab.sampled import SampledLaw, response


def _impedance(a: LinearActuator, s: np.ndarray, on_angle: np.ndarray, on_deflection: np.ndarray) -> np.ndarray:
    """tau_m = −on_angle theta − on_deflection (theta − q), solved for the spring's torque while q moves."""
    spring = a.stiffness + a.damping * s
    rotor = a.inertia * s**2 + a.viscous * s + on_angle
    # rotor theta + (spring + on_deflection) (theta − q) = 0
    deflection = -rotor / (rotor + spring + on_deflection)  # per q
    return -spring * deflection / s


def continuous(law: str, a: LinearActuator, g: Gains, omega: np.ndarray) -> np.ndarray:
    """Z of a law of ``hil.joint_lab.continuous`` at ``omega`` rad/s (n,), N m s/rad."""
    s = 1j * omega
    feedback = FEEDBACKS[law](a, g)
    below = feedback.denominator(s)
    return _impedance(a, s, s * feedback.velocity(s) / below, feedback.deflection(s) / below)


def sampled(law: SampledLaw, a: LinearActuator, delay: float, omega: np.ndarray) -> np.ndarray:
    """Z with the law at its samples and a hold that lags by ``delay`` s, at ``omega`` rad/s (n,), N m s/rad."""
    s = 1j * omega
    hold = -np.expm1(-s * law.period) / (s * law.period) * np.exp(-s * delay)
    gains = -response(law.system, np.exp(s * law.period))[:, 0, :2]  # of the angle, of the deflection
    return _impedance(a, s, gains[:, 0] * hold, gains[:, 1] * hold)


class Passivity(NamedTuple):
    """``passive`` when the real part is nowhere negative; else the lowest and the worst frequency where it is."""

    passive: bool
    from_hz: float | None = None
    worst_hz: float | None = None
    worst: float | None = None  # N m s/rad


def passivity(omega: np.ndarray, impedance: np.ndarray) -> Passivity:
    """Judge ``impedance`` at ``omega`` rad/s, up to rounding: 1e-9 of its magnitude."""
    real = impedance.real
    failing = np.flatnonzero(real < -1e-9 * np.abs(impedance))
    if not len(failing):
        return Passivity(True)
    hertz = omega / (2.0 * np.pi)
    worst = failing[np.argmin(real[failing])]
    return Passivity(False, float(hertz[failing[0]]), float(hertz[worst]), float(real[worst]))
