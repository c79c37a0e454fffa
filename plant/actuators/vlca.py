"""The viscoelastic liquid-cooled actuator (Kim 2018 §5.3.1, App. C, D), in equivalent rotary coordinates.

Motor, belt and ball screw at phi, an elastomer, and a linkage to the joint, phi_q = f(q), f' = N_l / r0:

    F = k (x − c z) + d dx,   x = phi − f(q),   dz = (x − z) / T        (standard linear solid beside a damper)
    J ddphi = tau_m − F − b dphi − friction,    tau_joint = f'(q) F

After a step of deflection the force relaxes from k x to k (1 − c) x with time constant T. With the output fixed and
without relaxation this is Kim 2018 (5.11). The rubber really sits between chassis and ground, with the chassis' mass
m_r; lumped with the reflected rotor, which is 300 times as heavy, it is the same equation (exact for a fixed output).

Belt and screw lose by friction in proportion to the transmitted force, (1 − η)/η of it: driving, η of the motor's power
arrives; driven, 2 − 1/η of the output's, as for ball screws. Without this friction (``world.friction_scale = 0``) the
loss is the share 1 − η of the motor's torque in either direction, as the linear model (5.11) has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import casadi as ca

from plant.actuators import motor
from plant.actuators.friction import slide
from plant.actuators.model import ActuatorModel, Inputs, Sensed, Symbol
from robots.actuators import Viscoelastic


class ViscoelasticModel(ActuatorModel, describes=Viscoelastic):
    """States: phi [rad], dphi [rad/s], relaxed (z) [rad], supply [V] under load, and the motor's."""

    friction = ("load_friction",)

    def parameters(self) -> Mapping[str, float]:
        a = self.actuator
        return {
            "stiffness": a.stiffness,
            "damping": a.damping,
            "creep": a.elastomer.creep,
            "creep_time_constant": a.elastomer.creep_time_constant,
            "inertia": a.rotor_inertia,
            "torque_per_ampere": a.torque_per_ampere / a.efficiency,
            "load_friction": (1 - a.efficiency) / a.efficiency,
            "viscous": a.viscous,
            "supply_power": a.supply_power,
            **motor.parameters(a),
        }

    def rest(self, q: float) -> Mapping[str, float]:
        phi = float(self.actuator.linkage.motor_coordinate(q))
        return {"phi": phi, "dphi": 0.0, "relaxed": 0.0, "supply": self.actuator.supply_voltage, **motor.rest()}

    def step(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace, dt: float) -> tuple[Mapping[str, Symbol], Symbol]:
        deflection, effort = self._elastomer(x, u, p)
        passed = self._passed(p)
        flow = motor.flow(x, u, p, x.dphi, effort, dt, passed, p.supply_power)
        friction = p.load_friction * ca.fabs(effort)
        net = passed * p.torque_per_ampere * flow.current - effort
        dphi = slide(x.dphi, net, p.inertia, dt, friction, friction, p.viscous)
        after = {
            "phi": x.phi + dt * dphi,
            "dphi": dphi,
            "relaxed": x.relaxed + (deflection - x.relaxed) * dt / p.creep_time_constant,
            "current": flow.current,
            "supply": flow.supply,
        }
        return {**after, **motor.warm(x, p, flow.heat, dt)}, self.actuator.linkage.ratio(u.q) * effort

    def sense(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Sensed:
        deflection, effort = self._elastomer(x, u, p)
        return Sensed(
            motor=x.phi, motor_velocity=x.dphi, deflection=deflection, effort=effort,
            torque=self.actuator.linkage.ratio(u.q) * effort, current=x.current, temperature=x.winding, supply=x.supply,
        )  # fmt: skip

    def _elastomer(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> tuple[Symbol, Symbol]:
        """Deflection [rad] and effort [N m]."""
        linkage = self.actuator.linkage
        deflection = x.phi - linkage.motor_coordinate(u.q)
        rate = x.dphi - linkage.ratio(u.q) * u.dq
        return deflection, p.stiffness * (deflection - p.creep * x.relaxed) + p.damping * rate

    def _passed(self, p: SimpleNamespace) -> Symbol:
        """Share of the motor's torque that is left when what the friction does not take is lost in proportion."""
        efficiency = self.actuator.efficiency
        if efficiency == 1:
            return 1.0
        whole = (1 - efficiency) / efficiency
        return 1 - (1 - efficiency) * ca.fmax(1 - p.load_friction / whole, 0)
