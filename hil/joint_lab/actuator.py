"""The linear model of an actuator: a rotor behind a spring, an output that is clamped or carries an inertia.

Everything is seen from the joint, as in ``plant.sea``, without dry friction:

    J ddtheta = tau_m − b dtheta − tau_s,   I ddq = tau_s − c dq + tau_e,   tau_s = k (theta − q) + d (dtheta − dq)

tau_m is the motor's torque, tau_e an external one on the output. A drive senses theta and the deflection theta − q, and
takes k (theta − q) for the torque.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

S = Polynomial([0.0, 1.0])  # the Laplace variable


class LinearActuator(NamedTuple):
    """Parameters of the model. ``load`` is infinite for a clamped output (P_l = 0 in Kim 2018 (5.9))."""

    inertia: float  # J, kg m²: the rotor's
    viscous: float  # b, N m s/rad
    stiffness: float  # k, N m/rad
    damping: float  # d, N m s/rad: the spring's
    torque_per_ampere: float  # N m/A
    load: float = math.inf  # I, kg m²
    load_damping: float = 0.0  # c, N m s/rad

    @property
    def clamped(self) -> bool:
        return math.isinf(self.load)


class Responses(NamedTuple):
    """Deflection and motor velocity over motor torque, as polynomials in s over one denominator."""

    deflection: Polynomial
    velocity: Polynomial
    denominator: Polynomial


def responses(a: LinearActuator) -> Responses:
    """Kim 2018 (5.9) and, of a clamped output, (5.11), in the joint's coordinates: 1/(N m) rad, 1/(N m) rad/s."""
    rotor, spring = a.inertia * S + a.viscous, a.stiffness + a.damping * S
    if a.clamped:
        return Responses(Polynomial([1.0]), S, S * rotor + spring)
    load = a.load * S + a.load_damping
    return Responses(load, S * load + spring, rotor * (S * load + spring) + spring * load)


class StateSpace(NamedTuple):
    """``dx/dt`` (or the next x) ``= a x + b u``, ``y = c x + d u``."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray


def state_space(a: LinearActuator) -> StateSpace:
    """The model from motor torque [N m] to (theta [rad], deflection [rad]); states (theta, dtheta[, q, dq])."""
    k, d, j = a.stiffness, a.damping, a.inertia
    if a.clamped:
        matrix = np.array([[0.0, 1.0], [-k / j, -(a.viscous + d) / j]])
        drive, sense = np.array([[0.0], [1.0 / j]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    else:
        i = a.load
        matrix = np.array([
            [0.0, 1.0, 0.0, 0.0],
            [-k / j, -(a.viscous + d) / j, k / j, d / j],
            [0.0, 0.0, 0.0, 1.0],
            [k / i, d / i, -k / i, -(d + a.load_damping) / i],
        ])  # fmt: skip
        drive = np.array([[0.0], [1.0 / j], [0.0], [0.0]])
        sense = np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, -1.0, 0.0]])
    return StateSpace(matrix, drive, sense, np.zeros((2, 1)))
