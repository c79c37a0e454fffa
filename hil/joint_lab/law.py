"""A drive's law, linearised where it is implemented, so that theory and firmware cannot part.

What is linearised is the very function that the firmware evaluates, from encoder counts to current counts, at rest and
enabled; only the rounding to counts is left out.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from bus.messages import GainSet, Mode
from hil.joint_lab.actuator import StateSpace
from hil.joint_lab.continuous import Gains
from hil.joint_lab.sampled import SampledLaw
from joint_firmware.config import FirmwareConfig, TorqueGains
from joint_firmware.laws import drive_law, signals
from joint_firmware.protection_config import UNPROTECTED
from robots import pins
from robots.actuators import Hydraulic
from robots.description import Joint

_NO_LIMIT = 1e9  # N m
_WEIGHTS = {Mode.TORQUE: signals.U_TORQUE_MODE, Mode.OPEN_LOOP: signals.U_OPEN_LOOP_MODE}
_TICKS = 100  # within which a law has come to rest


def _gains(config: FirmwareConfig, gain_set: int) -> TorqueGains:
    return config.swing if gain_set == GainSet.SWING else config.stance


def sampled_law(
    joint: Joint, firmware: FirmwareConfig, gain_set: int, mode: int = Mode.TORQUE, at: float = 0.0
) -> SampledLaw:
    """From (motor coordinate [rad], deflection [rad], torque commanded [N m]) to motor torque [N m], at joint ``at``;
    of a hydraulic joint from (joint angle [rad], effort [N m], torque commanded [N m]) to the valve's effort.

    ``mode`` is Mode.TORQUE, or Mode.OPEN_LOOP for the drive without its torque loop. States that the motor torque does
    not depend on, those of the protection, are left out.

    Raises ValueError for gains that the law itself refuses, and for velocities that have no derivative at rest.
    """
    if firmware.velocity_estimator != "filter":
        raise ValueError(
            f"firmware.velocity_estimator = {firmware.velocity_estimator}: between edges such a velocity has no "
            "derivative, the linear model needs filter"
        )
    config = firmware.of_joint(joint.name).model_copy(update={"protection": UNPROTECTED})
    law, gains = drive_law(joint, config), _gains(config, gain_set)
    u = np.zeros(signals.INPUT_SIZE)
    u[[signals.U_LIMIT, _WEIGHTS[mode], signals.U_ENABLED]] = _NO_LIMIT, 1.0, 1.0
    u[[signals.U_KP, signals.U_KI, signals.U_KD]] = gains.kp, gains.ki, gains.kd
    counts = np.zeros(signals.COUNTS_SIZE)
    counts[pins.MOTOR_ENCODER] = motor_coordinate(joint, at) * joint.sensor.encoder
    counts[pins.JOINT_ENCODER] = at * joint.sensor.joint_encoder
    counts[pins.SUPPLY_ADC] = joint.actuator.supply_voltage / pins.VOLT_PER_COUNT
    p = law.values(joint, config)
    smooth = without_rounding(law.function)
    x = np.zeros(len(law.states))
    for _ in range(_TICKS):
        before, x = x, np.array(smooth(counts, x, u, p)[0]).ravel()
    a, b_counts, b_u, c, d_counts, d_u = (np.array(part) for part in _jacobians(smooth)(counts, x, u, p))
    kept = _seen(a, c)
    if not np.allclose(before[kept], x[kept], rtol=1e-9, atol=1e-12):
        raise AssertionError(f"{config.law} is not at rest after {_TICKS} interrupts")
    if isinstance(joint.actuator, Hydraulic):
        sensors = [pins.JOINT_ENCODER, pins.FORCE_ADC]
        scales = [joint.sensor.joint_encoder, 1.0 / joint.sensor.force_resolution]  # counts per rad, per N m
    else:
        sensors = [pins.MOTOR_ENCODER, pins.SPRING_ENCODER]
        scales = [joint.sensor.encoder, joint.spring_counts_per_rad]  # counts per rad
    torque = joint.actuator.ampere_per_count * joint.actuator.torque_per_ampere  # N m per count of current
    system = StateSpace(
        a[np.ix_(kept, kept)], np.hstack([b_counts[:, sensors] * scales, b_u[:, [signals.U_TORQUE]]])[kept],
        torque * c[:, kept], torque * np.hstack([d_counts[:, sensors] * scales, d_u[:, [signals.U_TORQUE]]]),
    )  # fmt: skip
    return SampledLaw(system, 1.0 / config.rate)


def _seen(a: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Indices of the states that the output depends on, sooner or later."""
    seen = c.any(axis=0)
    while (more := seen | a[seen].any(axis=0)).sum() > seen.sum():
        seen = more
    return np.flatnonzero(seen)


def motor_coordinate(joint: Joint, q: float) -> float:
    """phi = f(q), rad (``robots.actuators``)."""
    linkage = joint.actuator.linkage
    return q if linkage is None else float(linkage.motor_coordinate(q))


def gains_of(joint: Joint, firmware: FirmwareConfig, gain_set: int) -> Gains:
    """The same settings for ``hil.joint_lab.continuous``."""
    config = firmware.of_joint(joint.name)
    gains = _gains(config, gain_set)
    return Gains(
        gains.kp, gains.ki, gains.kd, config.torque_rate_cutoff, config.observer_cutoff, config.velocity_integral
    )


def _jacobians(smooth: ca.Function) -> ca.Function:
    """Of the next state and the current demanded [counts], with respect to state, counts and command."""
    counts, x, u, p = (ca.SX.sym(name, smooth.size1_in(n)) for n, name in enumerate(("counts", "x", "u", "p")))
    x_next, y = smooth(counts, x, u, p)
    demand = y[signals.Y_DEMAND]
    return ca.Function(
        "jacobians", [counts, x, u, p], [ca.jacobian(of, by) for of in (x_next, demand) for by in (x, counts, u)]
    )


def without_rounding(function: ca.Function) -> ca.Function:
    """``function`` of scalar expressions, with its floors replaced by their arguments."""
    arguments = [ca.SX.sym(function.name_in(n), function.size1_in(n)) for n in range(function.n_in())]
    results = [ca.SX.zeros(function.size1_out(n)) for n in range(function.n_out())]
    work: dict[int, ca.SX] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        at, given = function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_CONST:
            work[at[0]] = ca.SX(function.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            work[at[0]] = arguments[given[0]][given[1]]
        elif operation == ca.OP_OUTPUT:
            results[at[0]][at[1]] = work[given[0]]
        elif operation == ca.OP_FLOOR:
            work[at[0]] = work[given[0]]
        elif len(given) == 1:
            work[at[0]] = ca.SX.unary(operation, work[given[0]])
        else:
            work[at[0]] = ca.SX.binary(operation, work[given[0]], work[given[1]])
    return ca.Function("smooth", arguments, results)
