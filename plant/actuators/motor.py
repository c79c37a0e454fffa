"""The electrical and thermal side of a motor behind a drive, shared by all actuators that have one.

The drive's current loop is ideal within the voltage that is left: the current is the demanded one unless

    |R i + k ω| ≤ V    (back-EMF k ω; a motor that is driven faster than that feeds current back through the bridge)
    i (R i + k ω) ≤ P  (a supply of limited power: beyond it its voltage falls to what the motor takes)

would not hold. Copper's resistance rises with its temperature, which follows from two thermal masses:

    C_w dT_w = R i² − (T_w − T_h) / R_wh,      C_h dT_h = (T_w − T_h) / R_wh − (T_h − T_a) / R_ha
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca

from plant.actuators.model import Inputs, Symbol
from robots.actuators import AMBIENT, COPPER, Actuator


class Flow(NamedTuple):
    """What flows during a step."""

    current: Symbol  # A
    supply: Symbol  # V, under load
    heat: Symbol  # W in the winding


def parameters(actuator: Actuator) -> Mapping[str, float]:
    """The motor's share of an actuator's parameters. Raises ValueError for an actuator without a motor."""
    motor, thermal = actuator.motor, actuator.thermal
    if motor is None or thermal is None:
        raise ValueError(f"{type(actuator).__name__} describes no motor")
    return {
        "current_limit": actuator.current_limit,
        "resistance": motor.resistance,
        "winding_to_housing": thermal.winding_to_housing,
        "housing_to_ambient": thermal.housing_to_ambient,
        "winding_capacity": thermal.winding_capacity,
        "housing_capacity": thermal.housing_capacity,
        "ambient": AMBIENT,
    }


def rest() -> Mapping[str, float]:
    """The motor's share of an actuator's state: current [A], temperatures [°C]."""
    return {"current": 0.0, "winding": AMBIENT, "housing": AMBIENT}


def flow(
    x: SimpleNamespace, u: Inputs, p: SimpleNamespace, velocity: Symbol, load: Symbol, dt: float,
    passed: Symbol = 1.0, power: Symbol | None = None,
) -> Flow:  # fmt: skip
    """Current during a step of a rotor with ``velocity`` [rad/s] at its start, under ``load`` [N m].

    The back-EMF is that of the step's end, as of an implicit step (dry friction apart): a light rotor on a winding of
    little resistance would else oscillate on it. ``passed``: share of the motor's torque that accelerates the rotor.
    ``power`` [W] limits the supply.
    """
    constant, inertia = p.torque_per_ampere, p.inertia + dt * p.viscous
    resistance = p.resistance * (1 + COPPER * (x.winding - AMBIENT))
    emf = constant * (p.inertia * velocity - dt * load) / inertia  # if no current flowed
    slope = resistance + passed * constant**2 * dt / inertia
    wanted = ca.fmin(ca.fmax(u.current, -p.current_limit), p.current_limit)
    current = ca.fmin(ca.fmax(wanted, (-u.supply - emf) / slope), (u.supply - emf) / slope)
    supply = u.supply
    if power is not None:
        root = ca.sqrt(emf**2 + 4 * slope * power)
        within = ca.fmin(ca.fmax(current, -(root + emf) / (2 * slope)), (root - emf) / (2 * slope))
        supply = ca.if_else(within == current, u.supply, ca.fabs(slope * within + emf))
        current = within
    return Flow(current, supply, resistance * current**2)


def warm(x: SimpleNamespace, p: SimpleNamespace, heat: Symbol, dt: float) -> dict[str, Symbol]:
    """Temperatures after a step with ``heat`` [W] in the winding."""
    into_housing = (x.winding - x.housing) / p.winding_to_housing
    into_ambient = (x.housing - p.ambient) / p.housing_to_ambient
    return {
        "winding": x.winding + dt * (heat - into_housing) / p.winding_capacity,
        "housing": x.housing + dt * (into_housing - into_ambient) / p.housing_capacity,
    }
