"""What the torque loop is to follow: commanded torque or position, within limits of size and rate.

Position is that of the motor: fed back from where the torque acts, it is damped whatever the spring carries (Kim 2018
§5.4.1); fed back from a light joint behind the spring, it oscillates as soon as friction does not hold it.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as s
from joint_firmware.laws.block import Block, Offsets, Symbols, clip
from robots.description import Joint


class Wanted(NamedTuple):
    """The reference, N m; whether one is wanted at all (0 or 1); whether a limit holds it back."""

    torque: ca.SX
    active: ca.SX
    limited: ca.SX


class Reference(Block):
    states = ("torque_reference", "active")
    parameters = (
        "torque_limit", "torque_step", "position_low", "position_high", "soft_stop_stiffness",
        "position_stiffness", "position_damping",
    )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        low, high = joint.limits
        return {
            "torque_limit": config.torque_limit,
            "torque_step": config.torque_rate / config.rate,
            "position_low": low,
            "position_high": high,
            "soft_stop_stiffness": config.soft_stop_stiffness,
            "position_stiffness": config.position_stiffness,
            "position_damping": config.position_damping,
        }

    def follow(self, u: ca.SX, sensed: s.Sensed, x: Symbols, p: Symbols) -> tuple[Wanted, Symbols]:
        """The reference, and the states of the next tick."""
        wanted = u[s.U_TORQUE_MODE] * u[s.U_TORQUE] + u[s.U_POSITION_MODE] * (
            u[s.U_TORQUE]
            + p.position_stiffness * (u[s.U_POSITION] - sensed.motor_position)
            + p.position_damping * (u[s.U_VELOCITY] - sensed.motor_velocity)
        )
        overshoot = ca.fmax(sensed.position - p.position_high, 0) + ca.fmin(sensed.position - p.position_low, 0)
        wanted = wanted - p.soft_stop_stiffness * overshoot
        limit = ca.fmin(p.torque_limit, u[s.U_LIMIT])
        bounded = clip(wanted, -limit, limit)
        active = u[s.U_TORQUE_MODE] + u[s.U_POSITION_MODE]
        # switched on: from what the spring holds
        before = ca.if_else(x.active > 0, x.torque_reference, sensed.torque)
        step = bounded - before
        reference = before + clip(step, -p.torque_step, p.torque_step)
        limited = ca.logic_or(ca.logic_or(ca.fabs(wanted) > limit, ca.fabs(step) > p.torque_step), overshoot != 0)
        return Wanted(reference, active, limited), Symbols(torque_reference=active * reference, active=active)
