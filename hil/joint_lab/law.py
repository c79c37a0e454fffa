"""A drive's law, linearised where it is implemented, so that theory and firmware cannot part.

What is linearised is the very function that the firmware evaluates, from encoder counts to current counts, at rest and
enabled in cyclic synchronous torque; only the rounding to counts is left out.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from bus.messages import GainSet
from hil.joint_lab.actuator import StateSpace
from hil.joint_lab.continuous import Gains
from hil.joint_lab.sampled import SampledLaw
from joint_firmware.config import FirmwareConfig, TorqueGains
from joint_firmware.laws import drive_law, signals
from robots import pins
from robots.description import Joint

_NO_LIMIT = 1e9  # N m


def gains_in(firmware: FirmwareConfig, gain_set: int) -> TorqueGains:
    """The gains of ``bus.messages.GainSet``."""
    return firmware.swing if gain_set == GainSet.SWING else firmware.stance


def sampled_law(joint: Joint, firmware: FirmwareConfig, gain_set: int = GainSet.STANCE) -> SampledLaw:
    """From (theta [rad], deflection [rad], torque commanded [N m]) to motor torque [N m]."""
    law = drive_law(joint, firmware)
    gains = gains_in(firmware, gain_set)
    x = np.zeros(len(law.states))
    for name, value in {"active": 1.0, "started": 1.0, "kp": gains.kp, "ki": gains.ki, "kd": gains.kd}.items():
        x[law.states.index(name)] = value
    u = np.zeros(signals.INPUT_SIZE)
    u[[signals.U_LIMIT, signals.U_TORQUE_MODE]] = _NO_LIMIT, 1.0
    u[[signals.U_KP, signals.U_KI, signals.U_KD]] = gains.kp, gains.ki, gains.kd
    counts = np.zeros(signals.COUNTS_SIZE)
    a, b_counts, b_u, c, d_counts, d_u = (
        np.array(part) for part in _jacobians(law.function)(counts, x, u, law.values(joint, firmware))
    )
    encoders = [pins.MOTOR_ENCODER, pins.SPRING_ENCODER]
    scales = [joint.sensor.encoder, joint.spring_counts_per_rad]  # counts per rad
    torque = joint.actuator.ampere_per_count * joint.actuator.torque_per_ampere  # N m per count of current
    return SampledLaw(
        StateSpace(
            a, np.hstack([b_counts[:, encoders] * scales, b_u[:, [signals.U_TORQUE]]]),
            torque * c, torque * np.hstack([d_counts[:, encoders] * scales, d_u[:, [signals.U_TORQUE]]]),
        ),
        1.0 / firmware.rate,
    )  # fmt: skip


def gains_of(joint: Joint, firmware: FirmwareConfig, gain_set: int = GainSet.STANCE) -> Gains:
    """The same settings for ``hil.joint_lab.continuous``."""
    gains = gains_in(firmware, gain_set)
    return Gains(gains.kp, gains.ki, gains.kd)


def _jacobians(law: ca.Function) -> ca.Function:
    """Of the next state and the current demanded [counts], with respect to state, counts and command."""
    smooth = without_rounding(law)
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
