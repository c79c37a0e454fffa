"""What the drive is to do: commanded torque, or that of a position loop, within limits of size and rate.

The modes, with tau, q_d, dq_d as commanded, phi_d = f(q_d):

    torque, open loop    tau
    position             tau + f' (K_m (phi_d − phi) + D_m (f' dq_d − dphi))
    motor position       the same with phi_d = f(q_d) + tau / (k f')                         Kim 2018 (5.22), (5.23)
    joint position       tau + K_q (q_d − q) + D_q (dq_d − dq)                               Kim 2018 §7.1.2, Fig. 7.1
    impedance            tau + K_i (q_d − q) + D_i (dq_d − dq)

Open loop and motor position act on the motor without a torque loop; what the others give is its reference. The position
of the motor is fed back where damping must not depend on what the spring carries (§5.4.1): fed back from a light joint
behind the spring, a stiff loop oscillates as soon as friction does not hold it.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as s
from joint_firmware.laws.block import Block, Offsets, Symbols, clip
from joint_firmware.laws.sensing import JointMap
from robots.description import Joint

_GAINS = (
    "position_stiffness", "position_damping", "joint_stiffness", "joint_damping",
    "impedance_stiffness", "impedance_damping",
)  # fmt: skip


class Wanted(NamedTuple):
    """What is wanted of the torque loop."""

    effort: ca.SX  # N m
    active: ca.SX  # 0: nothing is wanted
    closed: ca.SX  # 1: of the torque loop, 0: of the motor
    limited: ca.SX  # whether a limit holds it back


class Reference(Block):
    states = ("torque_reference", "active")
    parameters = (
        "torque_limit", "torque_step", "position_low", "position_high", "soft_stop_stiffness", "stiffness", *_GAINS,
    )  # fmt: skip

    def __init__(self, joint_map: JointMap) -> None:
        self._map = joint_map

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        low, high = joint.limits
        return {
            "torque_limit": config.torque_limit,
            "torque_step": config.torque_rate / config.rate,
            "position_low": low,
            "position_high": high,
            "soft_stop_stiffness": config.soft_stop_stiffness,
            "stiffness": joint.actuator.stiffness,
            **{name: getattr(config, name) for name in _GAINS},
        }

    def follow(self, u: ca.SX, sensed: s.Sensed, x: Symbols, p: Symbols) -> tuple[Wanted, Symbols]:
        """What is wanted, and the states of the next tick."""
        limit = ca.fmin(p.torque_limit, u[s.U_LIMIT])
        of_motor = u[s.U_POSITION_MODE] + u[s.U_MOTOR_POSITION_MODE]
        direct = u[s.U_TORQUE_MODE] + u[s.U_OPEN_LOOP_MODE] + of_motor
        joint_loops = u[s.U_JOINT_POSITION_MODE], u[s.U_IMPEDANCE_MODE]
        active = direct + joint_loops[0] + joint_loops[1]
        wanted = active * u[s.U_TORQUE] + of_motor * sensed.ratio * self._motor_loop(u, sensed, limit, p)
        stiffness = joint_loops[0] * p.joint_stiffness + joint_loops[1] * p.impedance_stiffness
        damping = joint_loops[0] * p.joint_damping + joint_loops[1] * p.impedance_damping
        wanted += stiffness * (u[s.U_POSITION] - sensed.position) + damping * (u[s.U_VELOCITY] - sensed.velocity)
        overshoot = ca.fmax(sensed.position - p.position_high, 0) + ca.fmin(sensed.position - p.position_low, 0)
        wanted -= p.soft_stop_stiffness * overshoot
        bounded = clip(wanted, -limit, limit)
        # switched on: from what the spring holds
        before = ca.if_else(x.active > 0, x.torque_reference, sensed.torque)
        step = bounded - before
        torque = before + clip(step, -p.torque_step, p.torque_step)
        closed = active - u[s.U_OPEN_LOOP_MODE] - u[s.U_MOTOR_POSITION_MODE]
        limited = ca.logic_or(ca.logic_or(ca.fabs(wanted) > limit, ca.fabs(step) > p.torque_step), overshoot != 0)
        after = Symbols(torque_reference=active * torque, active=active)
        return Wanted(torque / sensed.ratio, active, closed, limited), after

    def _motor_loop(self, u: ca.SX, sensed: s.Sensed, limit: ca.SX, p: Symbols) -> ca.SX:
        """Effort of the motor's position loop, N m."""
        carried = clip(u[s.U_TORQUE], -limit, limit) / (p.stiffness * sensed.ratio)  # deflection under it
        phi = self._map.to_motor(u[s.U_POSITION]) + u[s.U_MOTOR_POSITION_MODE] * carried
        return p.position_stiffness * (phi - sensed.motor_position) + p.position_damping * (
            sensed.ratio * u[s.U_VELOCITY] - sensed.motor_velocity
        )
