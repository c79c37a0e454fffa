"""Torque feedback with damping by the filtered derivative of the torque itself (Kim 2018 (5.12), (5.13)),

    effort = tau_d + kp (tau_d − tau) − (kd / k) Q_d tau,      Q_d = s / ((s/w_c)² + √2 (s/w_c) + 1)

With the output held, a spring k turns tau' / k into the motor's velocity: the same kd then damps as much as that of
PD_m (Kim 2018 §5.3.2: "K_d N_m / k_r for K_d,f").
"""

from __future__ import annotations

import math

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Offsets, Symbols
from joint_firmware.laws.filters import Filtered, LowPass, half_step
from joint_firmware.laws.signals import Gains
from joint_firmware.laws.torque_loop import Applied, LoopSignals, TorqueLoop
from robots.description import Joint


class TorqueRate(TorqueLoop):
    """Base of the loops that differentiate the sensed torque."""

    states: tuple[str, ...] = ("torque_low", "torque_rate")
    parameters: tuple[str, ...] = ("torque_rate_cutoff", "torque_rate_half_step", "stiffness")

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        cutoff = 2.0 * math.pi * config.torque_rate_cutoff
        return {
            "torque_rate_cutoff": cutoff,
            "torque_rate_half_step": half_step(cutoff, 1.0 / config.rate),
            "stiffness": joint.actuator.stiffness,
        }

    @staticmethod
    def filtered(s: LoopSignals, x: Symbols, p: Symbols) -> Filtered:
        low_pass = LowPass(x.torque_low, x.torque_rate, p.torque_rate_cutoff, p.torque_rate_half_step)
        return low_pass.filter(s.torque)


class PDf(TorqueRate):
    name = "PD_f"

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        rate = self.filtered(s, x, p).rate
        return s.reference + gains.kp * s.error - gains.kd / p.stiffness * rate

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, applied: Applied) -> Symbols:
        low, rate = self.filtered(s, x, p).next
        return Symbols(torque_low=low, torque_rate=rate)
