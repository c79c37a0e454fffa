"""The series elastic actuator, everything seen from the joint: a rotor of inertia J at theta drives the joint at q,

    tau_s = k (theta − q) + d (dtheta − dq),      J ddtheta = tau_m − tau_s − b dtheta − friction

with dry friction that grows with the transmitted torque.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import casadi as ca

from plant.actuators.friction import slide
from plant.actuators.model import ActuatorModel, Inputs, Sensed, Symbol
from robots.actuators import AMBIENT, SeriesElastic


class SeriesElasticModel(ActuatorModel, describes=SeriesElastic):
    """States: theta [rad], dtheta [rad/s]."""

    friction = ("coulomb", "static", "load_friction")

    def parameters(self) -> Mapping[str, float]:
        a = self.actuator
        return {
            "stiffness": a.stiffness,
            "damping": a.damping,
            "inertia": a.rotor_inertia,
            "torque_per_ampere": a.torque_per_ampere,
            "current_limit": a.current_limit,
            "coulomb": a.coulomb,
            "static": a.static,
            "load_friction": a.load_friction,
            "viscous": a.viscous,
        }

    def rest(self, q: float) -> Mapping[str, float]:
        return {"theta": q, "dtheta": 0.0}

    def step(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace, dt: float) -> tuple[Mapping[str, Symbol], Symbol]:
        spring = self._spring(x, u, p)
        friction = p.load_friction * ca.fabs(spring)
        dtheta = slide(
            x.dtheta, p.torque_per_ampere * self._current(u, p) - spring, p.inertia, dt,
            p.coulomb + friction, p.static + friction, p.viscous,
        )  # fmt: skip
        return {"theta": x.theta + dt * dtheta, "dtheta": dtheta}, spring

    def sense(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Sensed:
        spring = self._spring(x, u, p)
        return Sensed(
            motor=x.theta, motor_velocity=x.dtheta, deflection=x.theta - u.q, effort=spring, torque=spring,
            current=self._current(u, p), temperature=AMBIENT, supply=u.supply,
        )  # fmt: skip

    @staticmethod
    def _spring(x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Symbol:
        return p.stiffness * (x.theta - u.q) + p.damping * (x.dtheta - u.dq)

    @staticmethod
    def _current(u: Inputs, p: SimpleNamespace) -> Symbol:
        return ca.fmin(ca.fmax(u.current, -p.current_limit), p.current_limit)
