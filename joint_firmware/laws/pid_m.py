"""Torque feedback with damping by the motor's velocity and an optional integral (Kim 2018 (5.16), §5.1.1),

effort = tau_d + kp (tau_d − tau) + I − kd dphi,      I' = ki (tau_d − tau)
"""

from __future__ import annotations

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Offsets, Symbols
from joint_firmware.laws.signals import Gains
from joint_firmware.laws.torque_loop import Applied, LoopSignals, TorqueLoop
from robots.description import Joint


class PDm(TorqueLoop):
    """Without the integral, whatever ``ki`` is."""

    name = "PD_m"

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        return s.reference + gains.kp * s.error - gains.kd * s.motor_velocity


class PIDm(PDm):
    """What was integrated counts only while there is an integral gain."""

    name = "PID_m"
    states = ("integral",)
    parameters = ("dt",)

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {"dt": 1.0 / config.rate}

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        return super().effort(s, gains, x, p) + ca.if_else(gains.ki > 0, x.integral, 0)

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, applied: Applied) -> Symbols:
        return Symbols(integral=integrated(x.integral, gains.ki, s.error, p.dt, applied))


def integrated(
    integral: ca.SX, gain: ca.SX, error: ca.SX, dt: ca.SX, applied: Applied, without_gain: ca.SX | float = 0.0
) -> ca.SX:
    """The integral of ``gain`` times ``error`` one tick on: not beyond saturation, 0 without a loop in force."""
    growth = ca.if_else(applied.winds_up(error), 0, gain * error * dt)
    return applied.closed * ca.if_else(gain > 0, integral + growth, without_gain)
