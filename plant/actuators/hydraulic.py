"""The hydraulic joint: servo valve, double-acting cylinder, load cell, linkage (Merritt 1967 chapters 5, 6; Jelali and
Kroll 2003 §4.3). With the piston's extension x from mid-stroke, its velocity v, and the pressures p₁ (cap), p₂ (rod),

    dp₁/dt = β/V₁ (Q₁ − A₁ v),   dp₂/dt = β/V₂ (Q₂ + A₂ v),   V₁ = V₀ + A₁ (s/2 + x),   V₂ = V₀ + A₂ (s/2 − x)
    m dv/dt = p₁ A₁ − p₂ A₂ − F − friction,   F = k_c (x − x_joint) + d_c (v − v_joint)

F is what the load cell measures. An edge of the valve lets Q = k u √ΔP through, in the direction of ΔP; u, the share of
its opening, follows the current as a second-order system with a limited rate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca

from plant.actuators.friction import sign, slide
from plant.actuators.model import ActuatorModel, Inputs, Sensed, Symbol
from robots.actuators import AMBIENT, Hydraulic

LAMINAR_DROP = 2e5  # Pa; ASSUMED: below this drop an orifice's flow is laminar, and proportional to the drop
STRIBECK_VELOCITY = 0.01  # m/s; ASSUMED: friction of hydraulic seals falls over some mm/s (Jelali and Kroll 2003 §4.4)
FASTEST_PHASE = 0.25  # rad of the oil's oscillation in one sub-step: semi-implicit Euler is stable up to 2


class Flows(NamedTuple):
    """Into the chambers, m³/s, and by how much they fall as the chamber's pressure rises, m³/s/Pa."""

    cap: Symbol
    rod: Symbol
    cap_fall: Symbol
    rod_fall: Symbol


class HydraulicModel(ActuatorModel, describes=Hydraulic):
    """States: spool [share of the full opening], its rate [1/s], both pressures [Pa], piston [m], its velocity [m/s].

    A step is divided: the piston between oil and load cell oscillates at more than a kilohertz. Pressures are
    semi-implicit in the piston's velocity and linearly implicit in themselves, as a valve may empty a small chamber in
    less than a sub-step. Meanwhile the joint moves on with its velocity; it feels the mean of the load cell's force.
    """

    friction = ("coulomb", "static")

    def parameters(self) -> Mapping[str, float]:
        a = self.actuator
        return {
            "supply_pressure": a.supply_pressure,
            "return_pressure": a.return_pressure,
            "bulk_modulus": a.bulk_modulus,
            "leakage": a.leakage,
            "valve_flow": a.valve_flow,
            "valve_leakage": a.valve_leakage,
            "valve_deadband": a.valve_deadband,
            "valve_offset": a.valve_offset,
            "current_limit": a.current_limit,
            "coulomb": a.coulomb,
            "static": a.static,
            "viscous": a.viscous_friction,
        }

    def rest(self, q: float) -> Mapping[str, float]:
        a = self.actuator
        pressure = 0.5 * (a.supply_pressure + a.return_pressure)
        balance = 0.5 * (1 + a.rod_area / a.piston_area)  # both chambers by the same share off their mean
        cap = pressure * a.rod_area / a.piston_area / balance
        return {
            "spool": 0.0, "spool_rate": 0.0, "cap": cap, "rod": pressure / balance,
            "piston": float(a.linkage.length(q)) - a.linkage.nominal_length, "velocity": 0.0,
        }  # fmt: skip

    @property
    def fastest(self) -> float:
        """Angular frequency of the piston between oil and load cell with the rod drawn in, rad/s: an upper bound."""
        a = self.actuator
        oil = a.bulk_modulus * sum(area**2 / a.dead_volume for area in (a.piston_area, a.rod_area))
        return math.sqrt((oil + a.cell_stiffness) / a.piston_mass)

    def step(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace, dt: float) -> tuple[Mapping[str, Symbol], Symbol]:
        linkage = self.actuator.linkage
        divisions = max(math.ceil(self.fastest * dt / FASTEST_PHASE), 1)
        h = dt / divisions
        joint, arm = linkage.length(u.q) - linkage.nominal_length, linkage.arm(u.q)
        demand = (self._current(u, p) - p.valve_offset) / self.actuator.current_limit
        total = 0
        for k in range(divisions):
            force = self._cell(x, joint + k * h * arm * u.dq, arm * u.dq)
            total = total + force
            x = self._divided(x, demand, force, p, h)
        return vars(x), arm * total / divisions

    def _divided(
        self, x: SimpleNamespace, demand: Symbol, force: Symbol, p: SimpleNamespace, h: float
    ) -> SimpleNamespace:
        """The state after a sub-step ``h`` under the ``force`` [N] on the load cell."""
        a = self.actuator
        spool, spool_rate = self._follow(x, demand, h)
        pushing = x.cap * a.piston_area - x.rod * a.rod_area - force + self._end_stop(x)
        velocity = slide(
            x.velocity, pushing, a.piston_mass, h, p.coulomb, p.static, p.viscous, STRIBECK_VELOCITY
        )  # fmt: skip
        piston = x.piston + h * velocity
        flows = self.flows(spool, x.cap, x.rod, p)
        volumes = self.volumes(piston)
        cap, rod = (
            ca.fmax(pressure + h * p.bulk_modulus * flow / (volume + h * p.bulk_modulus * fall), 0)  # no tension
            for pressure, flow, fall, volume in (
                (x.cap, flows.cap - a.piston_area * velocity, flows.cap_fall, volumes[0]),
                (x.rod, flows.rod + a.rod_area * velocity, flows.rod_fall, volumes[1]),
            )
        )
        return SimpleNamespace(
            spool=spool, spool_rate=spool_rate, cap=cap, rod=rod, piston=piston, velocity=velocity
        )  # fmt: skip

    def _follow(self, x: SimpleNamespace, demand: Symbol, h: float) -> tuple[Symbol, Symbol]:
        """Spool and its rate after ``h``: semi-implicit, between its stops."""
        a = self.actuator
        omega = 2 * math.pi * a.valve_bandwidth
        rate = (x.spool_rate + h * omega**2 * (demand - x.spool)) / (1 + 2 * a.valve_damping * omega * h)
        rate = ca.fmin(ca.fmax(rate, -a.valve_slew), a.valve_slew)
        spool = x.spool + h * rate
        within = ca.fabs(spool) <= 1
        return ca.if_else(within, spool, sign(spool)), ca.if_else(within, rate, 0)

    def flows(self, spool: Symbol, cap: Symbol, rod: Symbol, p: SimpleNamespace) -> Flows:
        """What valve and leaks let into the chambers at these pressures [Pa]."""
        a = self.actuator
        overlap = p.valve_deadband / a.current_limit
        opening = ca.fmax(ca.fabs(spool) - overlap, 0) / (1 - overlap)
        through = opening * p.valve_flow / math.sqrt(a.valve_drop)
        extending = spool > 0
        cap_port = ca.if_else(extending, p.supply_pressure, p.return_pressure)
        rod_port = ca.if_else(extending, p.return_pressure, p.supply_pressure)

        def chamber(port: Symbol, pressure: Symbol, other: Symbol) -> tuple[Symbol, Symbol]:
            drop = port - pressure
            root = ca.sqrt(ca.fabs(drop) + LAMINAR_DROP)
            centred = p.valve_leakage * (p.supply_pressure + p.return_pressure - 2 * pressure)
            flow = through * drop / root + centred + p.leakage * (other - pressure)
            return flow, through / root + 2 * p.valve_leakage + p.leakage

        (into_cap, cap_fall), (into_rod, rod_fall) = chamber(cap_port, cap, rod), chamber(rod_port, rod, cap)
        return Flows(into_cap, into_rod, cap_fall, rod_fall)

    def volumes(self, piston: Symbol) -> tuple[Symbol, Symbol]:
        """Of the chambers, m³."""
        a = self.actuator
        middle = ca.fmin(ca.fmax(piston, -0.5 * a.stroke), 0.5 * a.stroke)
        return (
            a.dead_volume + a.piston_area * (0.5 * a.stroke + middle),
            a.dead_volume + a.rod_area * (0.5 * a.stroke - middle),
        )

    def _end_stop(self, x: SimpleNamespace) -> Symbol:
        """Force of the cylinder's ends, as stiff as the load cell, N."""
        beyond = ca.fmax(ca.fabs(x.piston) - 0.5 * self.actuator.stroke, 0)
        return -self.actuator.cell_stiffness * sign(x.piston) * beyond

    def _cell(self, x: SimpleNamespace, joint: Symbol, velocity: Symbol) -> Symbol:
        """Force in the load cell with the joint's end of it at ``joint`` [m], N."""
        return self.actuator.cell_stiffness * (x.piston - joint) + self.actuator.cell_damping * (x.velocity - velocity)

    def sense(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Sensed:
        linkage = self.actuator.linkage
        arm, r0 = linkage.arm(u.q), linkage.nominal_arm
        force = self._cell(x, linkage.length(u.q) - linkage.nominal_length, arm * u.dq)
        return Sensed(
            motor=x.piston / r0, motor_velocity=x.velocity / r0, deflection=0.0, effort=force * r0,
            torque=force * arm, current=self._current(u, p), temperature=AMBIENT, supply=u.supply,
        )  # fmt: skip

    @staticmethod
    def _current(u: Inputs, p: SimpleNamespace) -> Symbol:
        return ca.fmin(ca.fmax(u.current, -p.current_limit), p.current_limit)
