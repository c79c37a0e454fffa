"""What goes into a drive's law and what comes out: indices that hold for every law.

``counts`` are the input pins by their numbers (``robots.pins``), ``u`` is what the command asks for, ``y`` what the
drive reports and does. States and parameters differ by law; they go by name (``DriveLaw.states``, ``.parameters``).
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from robots import pins

COUNTS_SIZE = pins.N_INPUTS
# input u (mode weights are 0 or 1; so is whether operation is enabled: a drive that stops takes no time over it)
INPUT_SIZE = 15
(
    U_TORQUE, U_POSITION, U_VELOCITY, U_LIMIT, U_TORQUE_MODE, U_POSITION_MODE, U_DAMPING_MODE,
    U_KP, U_KI, U_KD,
    U_OPEN_LOOP_MODE, U_MOTOR_POSITION_MODE, U_JOINT_POSITION_MODE, U_IMPEDANCE_MODE, U_ENABLED,
) = range(INPUT_SIZE)  # fmt: skip
# output y: integers for the message and the pins, then the limit flag, the sensed values in SI, the trips, and the
# joint's position if the compliant element were relaxed
OUTPUT_SIZE = 11
(
    Y_POSITION, Y_VELOCITY, Y_TORQUE, Y_CURRENT, Y_MOTOR_VELOCITY, Y_DEMAND, Y_LIMITED,
    Y_TORQUE_SI, Y_POSITION_SI, Y_TRIPS, Y_RELAXED_SI,
) = range(OUTPUT_SIZE)  # fmt: skip


class Sensed(NamedTuple):
    """What the sensors say, in SI units; of the joint, and of the actuator in equivalent rotary coordinates."""

    motor_position: ca.SX  # phi, rad
    position: ca.SX  # q, rad, of the joint
    motor_velocity: ca.SX  # rad/s
    velocity: ca.SX  # rad/s, of the joint
    torque: ca.SX  # N m, on the joint
    effort: ca.SX  # N m, in the actuator's compliant element
    ratio: ca.SX | float  # f'(q): torque per effort
    output_velocity: ca.SX  # rad/s, of the actuator behind its compliant element


class Gains(NamedTuple):
    """Gains of a torque loop, of the set that the command names."""

    kp: ca.SX  # N m/(N m)
    ki: ca.SX  # N m/(N m s)
    kd: ca.SX  # N m s/rad
