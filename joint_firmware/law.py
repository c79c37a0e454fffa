"""The control law of a drive, one CasADi function: what is emulated here is what a DSP would run.

Cascade as on Hume (Kim 2018 §5.1.1, §7.3.1): torque feedback with motor-velocity damping and an optional
integral. The motor torque, seen from the joint, is

    tau_m = tau_d + kp (tau_d − tau) + I − kd dtheta,      I' = ki (tau_d − tau)

with tau the torque sensed in the spring, tau_d the commanded torque behind its limits, dtheta the motor's
velocity. All quantities are as seen from the joint; sizes are fixed; integers are exact in doubles.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from bus.messages import AMPERE, MOTOR_RADIAN_PER_SECOND, NEWTON_METRE, RADIAN, RADIAN_PER_SECOND
from joint_firmware.config import FirmwareConfig
from robots import pins
from robots.description import Joint

# state x
STATE_SIZE = 9
(
    THETA, POSITION, MOTOR_VELOCITY, VELOCITY, INTEGRAL, TORQUE_REFERENCE, KP, ACTIVE, STARTED,
) = range(STATE_SIZE)  # fmt: skip
# input u: what the command asks for (mode weights are 0 or 1)
INPUT_SIZE = 10
(
    U_TORQUE, U_POSITION, U_VELOCITY, U_LIMIT, U_TORQUE_MODE, U_POSITION_MODE, U_DAMPING_MODE,
    U_KP, U_KI, U_KD,
) = range(INPUT_SIZE)  # fmt: skip
# parameters p, one vector per drive
PARAMETER_SIZE = 17
# output y: integers for the message and the pins, then the limit flag and the sensed values in SI
OUTPUT_SIZE = 9
(
    Y_POSITION, Y_VELOCITY, Y_TORQUE, Y_CURRENT, Y_MOTOR_VELOCITY, Y_DEMAND, Y_LIMITED,
    Y_TORQUE_SI, Y_POSITION_SI,
) = range(OUTPUT_SIZE)  # fmt: skip

_I32, _I16 = 2**31 - 1, 2**15 - 1
_INTEGRAL_FADE_S = 0.1  # without integral gain, what was integrated fades instead of jumping


def parameters(
    joint: Joint, config: FirmwareConfig, motor_offset: float = 0.0, spring_offset: float = 0.0
) -> np.ndarray:
    """The parameter vector of ``joint``'s drive (PARAMETER_SIZE); offsets of the encoders in rad."""
    dt = 1.0 / config.rate
    return np.array([
        1.0 / joint.sensor.encoder,
        1.0 / joint.spring_counts_per_rad,
        joint.actuator.stiffness,
        joint.actuator.torque_per_ampere,
        joint.actuator.current_limit,
        dt,
        1.0 - math.exp(-2.0 * math.pi * config.velocity_cutoff * dt),
        config.torque_limit,
        config.torque_rate * dt,
        joint.limits[0],
        joint.limits[1],
        config.soft_stop_stiffness,
        config.quick_stop_damping,
        config.position_stiffness,
        config.position_damping,
        motor_offset,
        spring_offset,
    ])  # fmt: skip


def _round(value: ca.SX, limit: int) -> ca.SX:
    """``value`` rounded, within ±``limit``: a wild sensor must not overflow a field of the message."""
    return ca.fmin(ca.fmax(ca.floor(value + 0.5), -limit), limit)


def control_law() -> ca.Function:
    """The law ``(counts[3], x, u, p) -> (x_next, y)``; counts: motor encoder, spring encoder, current ADC."""
    counts, x = ca.SX.sym("counts", 3), ca.SX.sym("x", STATE_SIZE)
    u, p = ca.SX.sym("u", INPUT_SIZE), ca.SX.sym("p", PARAMETER_SIZE)
    (
        rad_per_count, rad_per_spring_count, stiffness, torque_per_ampere, current_limit, dt, blend,
        torque_limit, torque_step, low, high, stop_stiffness, quick_damping, position_stiffness,
        position_damping, motor_offset, spring_offset,
    ) = ca.vertsplit(p)  # fmt: skip
    started = x[STARTED]

    # sensing: the spring sits between motor and joint
    theta = counts[0] * rad_per_count - motor_offset
    deflection = counts[1] * rad_per_spring_count - spring_offset
    position, torque = theta - deflection, stiffness * deflection
    motor_velocity = x[MOTOR_VELOCITY] + started * blend * ((theta - x[THETA]) / dt - x[MOTOR_VELOCITY])
    velocity = x[VELOCITY] + started * blend * ((position - x[POSITION]) / dt - x[VELOCITY])

    # reference: commanded torque or position, within limits of size and rate. Position is that of the motor: fed back
    # from where the torque acts, it is damped whatever the spring carries (Kim 2018 §5.4.1); fed back from a light
    # joint behind the spring, it oscillates as soon as friction does not hold it.
    wanted = u[U_TORQUE_MODE] * u[U_TORQUE] + u[U_POSITION_MODE] * (
        u[U_TORQUE]
        + position_stiffness * (u[U_POSITION] - theta)
        + position_damping * (u[U_VELOCITY] - motor_velocity)
    )
    overshoot = ca.fmax(position - high, 0) + ca.fmin(position - low, 0)
    wanted = wanted - stop_stiffness * overshoot
    limit = ca.fmin(torque_limit, u[U_LIMIT])
    bounded = ca.fmin(ca.fmax(wanted, -limit), limit)
    active = u[U_TORQUE_MODE] + u[U_POSITION_MODE]
    before = ca.if_else(x[ACTIVE] > 0, x[TORQUE_REFERENCE], torque)  # switched on: from what the spring holds
    reference = before + ca.fmin(ca.fmax(bounded - before, -torque_step), torque_step)

    # torque loop; gains may switch: the proportional part's jump goes into the integral
    error = reference - torque
    carried = x[INTEGRAL] + ca.if_else(x[ACTIVE] > 0, (x[KP] - u[U_KP]) * error, 0)
    linear = reference + u[U_KP] * error - u[U_KD] * motor_velocity
    closed = linear + carried
    motor_torque = active * closed - u[U_DAMPING_MODE] * quick_damping * motor_velocity
    current = motor_torque / torque_per_ampere
    saturated = ca.fmin(ca.fmax(current, -current_limit), current_limit)
    winding = ca.logic_and(ca.fabs(current) > current_limit, current * error > 0)
    grown = carried + ca.if_else(winding, 0, u[U_KI] * error * dt)
    faded = carried * (1 - dt / _INTEGRAL_FADE_S)
    integral = active * ca.if_else(u[U_KI] > 0, grown, faded)

    limited = ca.logic_or(
        ca.logic_or(ca.fabs(wanted) > limit, ca.fabs(bounded - before) > torque_step),
        ca.logic_or(ca.fabs(current) > current_limit, overshoot != 0),
    )
    x_next = ca.vertcat(
        theta, position, motor_velocity, velocity, integral, active * reference, active * u[U_KP], active, 1
    )
    y = ca.vertcat(
        _round(position / RADIAN, _I32),
        _round(velocity / RADIAN_PER_SECOND, _I32),
        _round(torque / NEWTON_METRE, _I32),
        _round(counts[2] * pins.AMPERE_PER_COUNT / AMPERE, _I16),
        _round(motor_velocity / MOTOR_RADIAN_PER_SECOND, _I16),
        _round(saturated / pins.AMPERE_PER_COUNT, _I32),
        active * limited,
        torque,
        position,
    )
    return ca.Function(
        "joint_law", [counts, x, u, p], [x_next, y], ["counts", "x", "u", "p"], ["x_next", "y"]
    )
