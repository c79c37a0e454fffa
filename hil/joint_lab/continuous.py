"""Open loops of the torque laws in continuous time, after Kim 2018 (5.12)–(5.21).

A loop is cut where the sensors' data return, which is where the delay of a digital controller sits; it is a rational
function of s. The source writes them for a clamped output; here the output may carry an inertia.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from hil.joint_lab.actuator import LinearActuator, S, responses

DAMPING_5_13 = 1.414  # 2 ζ of the low-pass filters (Kim 2018 (5.13)): Butterworth's, to three decimals


class Gains(NamedTuple):
    """What a torque law is set to, in the joint's coordinates. Cut-off frequencies in Hz."""

    kp: float  # N m/(N m)
    ki: float = 0.0  # 1/s
    kd: float = 0.0  # N m s/rad
    derivative_cutoff: float = math.inf  # of PD_f's differentiated torque
    observer_cutoff: float = math.inf  # of the disturbance observer
    torque_kp: float = 0.0  # cascade: rad/s per N m
    torque_ki: float = 0.0  # cascade: rad/s² per N m
    velocity_kp: float = 0.0  # cascade: N m s/rad
    velocity_ki: float = 0.0  # cascade: N m/rad


class Rational(NamedTuple):
    """``numerator / denominator``, polynomials in s."""

    numerator: Polynomial
    denominator: Polynomial

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """Values at complex ``s``, of its shape."""
        return self.numerator(s) / self.denominator(s)

    def closed_loop_poles(self) -> np.ndarray:
        """Roots of 1 + L(s), rad/s."""
        return (self.numerator + self.denominator).roots()


def low_pass(cutoff: float) -> Polynomial:
    """Denominator of the second-order low-pass filter with ``cutoff`` in Hz, numerator 1 (Kim 2018 (5.13))."""
    w = S / (2.0 * math.pi * cutoff)
    return w**2 + DAMPING_5_13 * w + 1.0


def pd_f(a: LinearActuator, g: Gains) -> Rational:
    """Kim 2018 (5.15): damping by the low-passed derivative of the torque; K_d,f = kd / k."""
    plant, low = responses(a), low_pass(g.derivative_cutoff)
    return Rational((a.stiffness * g.kp * low + g.kd * S) * plant.deflection, plant.denominator * low)


def pd_m(a: LinearActuator, g: Gains) -> Rational:
    """Kim 2018 (5.17) without integral: damping by the motor's velocity."""
    plant = responses(a)
    return Rational(a.stiffness * g.kp * plant.deflection + g.kd * plant.velocity, plant.denominator)


def pid_m(a: LinearActuator, g: Gains) -> Rational:
    """Kim 2018 (5.17)."""
    proportional = pd_m(a, g)
    integral = a.stiffness * g.ki * responses(a).deflection
    return Rational(S * proportional.numerator + integral, S * proportional.denominator)


def pd_m_dob(a: LinearActuator, g: Gains) -> Rational:
    """Kim 2018 (5.21), whose observer inverts PD_m of the clamped actuator (5.18)."""
    plant, low = responses(a), low_pass(g.observer_cutoff)
    nominal = responses(a._replace(load=math.inf)).denominator + a.stiffness * g.kp + g.kd * S
    inner = pd_m(a, g).numerator
    return Rational(nominal * plant.deflection + inner * (low - 1.0), plant.denominator * (low - 1.0))


def cascade(a: LinearActuator, g: Gains) -> Rational:
    """Torque PI that asks an inner PI loop for motor velocity (Vallery et al. 2007, Kim 2018 §7.3.1)."""
    plant = responses(a)
    wanted = (g.torque_kp * S + g.torque_ki) * a.stiffness * plant.deflection
    velocity = g.velocity_kp * S + g.velocity_ki
    return Rational(velocity * (S * plant.velocity + wanted), S * S * plant.denominator)


OPEN_LOOPS: Mapping[str, Callable[[LinearActuator, Gains], Rational]] = {
    "PD_f": pd_f, "PD_m": pd_m, "PID_m": pid_m, "PD_m+DOB": pd_m_dob, "cascade": cascade,
}  # fmt: skip
