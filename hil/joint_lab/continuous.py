"""The torque laws in continuous time and their open loops, after Kim 2018 (5.12)–(5.21).

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

    kp: float = 0.0  # N m/(N m)
    ki: float = 0.0  # 1/s
    kd: float = 0.0  # N m s/rad
    derivative_cutoff: float = math.inf  # of PD_f's differentiated torque
    observer_cutoff: float = math.inf  # of the disturbance observer
    velocity_integral: float = 0.0  # 1/s, integral over proportional gain of the cascade's inner loop


class Feedback(NamedTuple):
    """A law's torque at the motor, −(deflection · (theta − q) + velocity · dtheta) / denominator: polynomials in s."""

    deflection: Polynomial  # N m/rad
    velocity: Polynomial  # N m s/rad
    denominator: Polynomial


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


_ONE = Polynomial([1.0])


def pd_f(a: LinearActuator, g: Gains) -> Feedback:
    """Kim 2018 (5.12): damping by the low-passed derivative of the torque; K_d,f = kd / k."""
    low = low_pass(g.derivative_cutoff)
    return Feedback(a.stiffness * g.kp * low + g.kd * S, 0.0 * S, low)


def pd_m(a: LinearActuator, g: Gains) -> Feedback:
    """Kim 2018 (5.16) without integral: damping by the motor's velocity."""
    return Feedback(a.stiffness * g.kp * _ONE, g.kd * _ONE, _ONE)


def pid_m(a: LinearActuator, g: Gains) -> Feedback:
    """Kim 2018 (5.16)."""
    return Feedback(a.stiffness * (g.kp * S + g.ki), g.kd * S, S)


def pd_m_dob(a: LinearActuator, g: Gains) -> Feedback:
    """Kim 2018 (5.19), whose observer inverts PD_m of the clamped actuator (5.18)."""
    unity = low_pass(g.observer_cutoff) - 1.0  # (1 − Q) / Q
    inverse = responses(a._replace(load=math.inf)).denominator + a.stiffness * g.kp + g.kd * S
    return Feedback(inverse + a.stiffness * g.kp * unity, g.kd * unity, unity)


def cascade(a: LinearActuator, g: Gains) -> Feedback:
    """Torque PI that asks an inner PI loop for motor velocity (Vallery et al. 2007, Kim 2018 §7.3.1).

    Its gains are those of ``joint_firmware.laws.cascade``: kd is the inner loop's proportional gain P_v, kp and ki are
    P_v times those of the torque's PI.
    """
    inner = S + g.velocity_integral
    return Feedback(inner * (g.kp * S + g.ki) * a.stiffness, inner * g.kd * S, S * S)


FEEDBACKS: Mapping[str, Callable[[LinearActuator, Gains], Feedback]] = {
    "PD_f": pd_f, "PD_m": pd_m, "PID_m": pid_m, "PD_m+DOB": pd_m_dob, "cascade": cascade,
}  # fmt: skip


def open_loop(law: str, a: LinearActuator, g: Gains) -> Rational:
    """Kim 2018 (5.15), (5.17), (5.21): the loop of one of FEEDBACKS, positive when it counteracts."""
    feedback, plant = FEEDBACKS[law](a, g), responses(a)
    numerator = feedback.deflection * plant.deflection + feedback.velocity * plant.velocity
    return Rational(numerator, feedback.denominator * plant.denominator)
