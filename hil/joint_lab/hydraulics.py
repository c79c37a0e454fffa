"""The linear model of a hydraulic joint: its valve about centre, no force, at rest (Merritt 1967 §6.2, §6.5).

    F' ≈ K_u u − K_v v        K_u = β (A₁ K_q1 / V₁ + A₂ K_q2 / V₂),    K_v = β (A₁² / V₁ + A₂² / V₂)

u is the share of the valve's opening, v the piston's velocity. K_v v is the natural velocity feedback: a moving
piston loses force as fast as the oil is stiff. k_vc = K_v / K_u of the valve's opening makes up for it (Boaventura et
al. 2012). An edge passes K_q u, whichever way the valve opens: of unequal pressure drops the mean. Seals have no dry
friction here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hil.joint_lab.actuator import StateSpace
from plant.actuators.hydraulic import LAMINAR_DROP
from plant.bench import Inertia, Load, Locked
from robots.actuators import Hydraulic
from robots.description import Joint

STATES = ("spool", "spool_rate", "cap", "rod", "piston", "velocity", "q", "dq")


class Chambers(NamedTuple):
    """Both chambers at rest without force: cap side, rod side."""

    stiffness: tuple[float, float]  # β/V, Pa/m³
    flow_gain: tuple[float, float]  # K_q, m³/s per full opening

    def force_gain(self, actuator: Hydraulic) -> float:
        """K_u, N/s per full opening."""
        areas = actuator.piston_area, actuator.rod_area
        return sum(b * a * k for b, a, k in zip(self.stiffness, areas, self.flow_gain, strict=True))

    def velocity_feedback(self, actuator: Hydraulic) -> float:
        """K_v, N/m."""
        return sum(b * a**2 for b, a in zip(self.stiffness, (actuator.piston_area, actuator.rod_area), strict=True))


def chambers(joint: Joint, at: float) -> Chambers:
    """The chambers with ``joint`` at rest at ``at`` [rad]."""
    a = _actuator(joint)
    x = float(a.linkage.length(at)) - a.linkage.nominal_length
    volumes = (
        a.dead_volume + a.piston_area * (0.5 * a.stroke + x),
        a.dead_volume + a.rod_area * (0.5 * a.stroke - x),
    )
    rod = (a.supply_pressure + a.return_pressure) / (1.0 + a.rod_area / a.piston_area)  # no force, mean of both
    pressures = (rod * a.rod_area / a.piston_area, rod)
    orifice = a.valve_flow / math.sqrt(a.valve_drop)
    drops = [(a.supply_pressure - p, p - a.return_pressure) for p in pressures]
    gains = tuple(0.5 * orifice * sum(drop / math.sqrt(drop + LAMINAR_DROP) for drop in both) for both in drops)
    return Chambers(tuple(a.bulk_modulus / v for v in volumes), gains)  # type: ignore[arg-type]


def velocity_compensation(joint: Joint, at: float) -> float:
    """k_vc at ``at`` [rad]: valve current per velocity of the piston, A s/m."""
    a, of = _actuator(joint), chambers(joint, at)
    return a.current_limit * of.velocity_feedback(a) / of.force_gain(a)


def state_space(joint: Joint, load: Load) -> StateSpace:
    """From the valve's current, as effort [N m] (``robots.actuators``), to (joint angle [rad], effort sensed [N m]).

    The states are ``STATES``; a locked joint has no q and dq. Raises ValueError for a load that is not linear.
    """
    a = _actuator(joint)
    if not isinstance(load, Locked | Inertia):
        raise ValueError("a pendulum is not linear: take locked or inertia=…")
    of, arm = chambers(joint, load.at), float(a.linkage.arm(load.at))
    omega = 2.0 * math.pi * a.valve_bandwidth
    own, cross = 2.0 * a.valve_leakage + a.leakage, a.leakage
    (b1, b2), (k1, k2), m = of.stiffness, of.flow_gain, a.piston_mass
    kc, dc = a.cell_stiffness, a.cell_damping
    cell = np.array([0.0, 0.0, 0.0, 0.0, kc, dc, -kc * arm, -dc * arm])  # force, N
    matrix = np.zeros((8, 8))
    matrix[0, 1] = 1.0
    matrix[1, :2] = -(omega**2), -2.0 * a.valve_damping * omega
    matrix[2, [0, 2, 3, 5]] = b1 * np.array([k1, -own, cross, -a.piston_area])
    matrix[3, [0, 2, 3, 5]] = b2 * np.array([-k2, cross, -own, a.rod_area])
    matrix[4, 5] = 1.0
    matrix[5] = -cell / m
    matrix[5, [2, 3]] += a.piston_area / m, -a.rod_area / m
    matrix[5, 5] -= a.viscous_friction / m
    drive = np.zeros((8, 1))
    drive[1] = omega**2 / (a.current_limit * a.torque_per_ampere)
    angle = np.zeros(8)
    angle[6] = 1.0
    sense = np.vstack([angle, cell * a.nominal_arm])
    if isinstance(load, Locked):
        matrix, drive, sense = matrix[:6, :6], drive[:6], sense[:, :6]
    else:
        matrix[6, 7] = 1.0
        matrix[7] = arm * cell / load.inertia
        matrix[7, 7] -= load.damping / load.inertia
    return StateSpace(matrix, drive, sense, np.zeros((2, 1)))


def _actuator(joint: Joint) -> Hydraulic:
    if not isinstance(joint.actuator, Hydraulic):
        raise ValueError(f"{joint.name} is not hydraulic")
    return joint.actuator
