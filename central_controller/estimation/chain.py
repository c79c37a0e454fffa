"""Kinematics and dynamics of a planar open chain as CasADi expressions: the model that foot estimators carry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np


class ChainLink(NamedTuple):
    """A link of a planar chain that turns about its near end."""

    length: float  # m, to the next joint or the end effector
    mass: float  # kg
    com: float  # m, of the centre of mass from the near end
    inertia: float  # kg m², about the centre of mass


class Chain:
    """``joints`` hinges in the vertical plane, coordinates x right and y up, angles from the link before (the first
    from the x axis).

    ``q``, ``dq``, ``torque`` (joints,) are symbols; ``position`` (2,) of the end effector [m], its ``jacobian``
    (2, joints) and the ``acceleration`` A⁻¹ (τ − b − g) (joints,) of Kim 2018 (6.27) expressions of them, by Lagrange's
    equation from the energies.
    """

    def __init__(self, links: Sequence[ChainLink], gravity: float = 9.81) -> None:
        self.joints = n = len(links)
        self.q, self.dq, self.torque = (ca.SX.sym(name, n) for name in ("q", "dq", "torque"))
        angles = ca.cumsum(self.q)
        end, energy, potential = ca.SX.zeros(2), ca.SX(0), ca.SX(0)
        for k, link in enumerate(links):
            direction = ca.vertcat(ca.cos(angles[k]), ca.sin(angles[k]))
            centre = end + link.com * direction
            velocity = ca.jacobian(centre, self.q) @ self.dq
            rate = ca.sum1(self.dq[: k + 1])
            energy += (link.mass * ca.dot(velocity, velocity) + link.inertia * rate * rate) / 2
            potential += link.mass * gravity * centre[1]
            end = end + link.length * direction
        self.position = end
        self.jacobian = ca.jacobian(end, self.q)
        momentum = ca.gradient(energy, self.dq)
        self.mass_matrix = ca.jacobian(momentum, self.dq)
        bias = ca.jacobian(momentum, self.q) @ self.dq - ca.gradient(energy, self.q) + ca.gradient(potential, self.q)
        self.acceleration = ca.solve(self.mass_matrix, self.torque - bias)
        self._position = ca.Function("position", [self.q], [self.position])
        self._jacobian = ca.Function("jacobian", [self.q], [self.jacobian])

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Position (2,) of the end effector [m] at the angles ``q``."""
        return np.asarray(self._position(q)).ravel()

    def jacobian_at(self, q: np.ndarray) -> np.ndarray:
        """Jacobian (2, joints) there."""
        return np.asarray(self._jacobian(q))
