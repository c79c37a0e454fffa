"""The series elastic actuator, everything seen from the joint: a rotor of inertia J at theta drives the joint at q,

    tau_s = k (theta − q) + d (dtheta − dq),      J ddtheta = tau_m − tau_s − b dtheta − friction

with dry friction that grows with the transmitted torque, and tau_m of a motor (``plant.actuators.motor``).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import casadi as ca

from plant.actuators import motor
from plant.actuators.friction import slide
from plant.actuators.model import ActuatorModel, Inputs, Sensed, Symbol
from robots.actuators import SeriesElastic


class SeriesElasticModel(ActuatorModel, describes=SeriesElastic):
    """States: theta [rad], dtheta [rad/s], and the motor's."""

    friction = ("coulomb", "static", "load_friction")

    def parameters(self) -> Mapping[str, float]:
        a = self.actuator
        return {
            "stiffness": a.stiffness,
            "damping": a.damping,
            "inertia": a.rotor_inertia,
            "torque_per_ampere": a.torque_per_ampere,
            "coulomb": a.coulomb,
            "static": a.static,
            "load_friction": a.load_friction,
            "viscous": a.viscous,
            **motor.parameters(a),
        }

    def rest(self, q: float) -> Mapping[str, float]:
        return {"theta": q, "dtheta": 0.0, **motor.rest()}

    def step(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace, dt: float) -> tuple[Mapping[str, Symbol], Symbol]:
        spring = self._spring(x, u, p)
        flow = motor.flow(x, u, p, x.dtheta, spring, dt)
        friction = p.load_friction * ca.fabs(spring)
        dtheta = slide(
            x.dtheta, p.torque_per_ampere * flow.current - spring, p.inertia, dt,
            p.coulomb + friction, p.static + friction, p.viscous,
        )  # fmt: skip
        after = {"theta": x.theta + dt * dtheta, "dtheta": dtheta, "current": flow.current}
        return {**after, **motor.warm(x, p, flow.heat, dt)}, spring

    def sense(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Sensed:
        spring = self._spring(x, u, p)
        return Sensed(
            motor=x.theta, motor_velocity=x.dtheta, deflection=x.theta - u.q, effort=spring, torque=spring,
            current=x.current, temperature=x.winding, supply=u.supply,
        )  # fmt: skip

    @staticmethod
    def _spring(x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Symbol:
        return p.stiffness * (x.theta - u.q) + p.damping * (x.dtheta - u.dq)
