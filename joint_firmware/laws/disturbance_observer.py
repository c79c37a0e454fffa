"""PD_m inside a disturbance observer (Kim 2018 (5.18)–(5.21)).

What PD_m should make of its reference r is known from the actuator's nominal parameters, with the output held:

    tau = P_c r,      P_c⁻¹ = (J s² + (b + kd) s + k (1 + kp)) / (k (1 + kp))                         (5.18)

The observer low-passes what r must have been, Q P_c⁻¹ tau, less what it was, Q r: the difference is a disturbance,
which is taken off the reference,

    r = tau_d − (Q P_c⁻¹ tau − Q r),      effort = r + kp (r − tau) − kd dphi                         (5.19)

Q is a second-order Butterworth low-pass, so that Q P_c⁻¹ is proper: it is Q tau, s Q tau and s² Q tau in proportion,
all three from one discrete filter. The r that is remembered is the one that the applied effort stands for.
"""

from __future__ import annotations

import math

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Offsets, Symbols
from joint_firmware.laws.filters import LowPass, half_step
from joint_firmware.laws.signals import Gains
from joint_firmware.laws.torque_loop import Applied, LoopSignals, TorqueLoop
from robots.description import Joint


class PDmDOB(TorqueLoop):
    name = "PD_m+DOB"
    states = ("observed_low", "observed_rate", "inner_low", "inner_rate")
    parameters = ("stiffness", "motor_inertia", "motor_damping", "observer_cutoff", "observer_half_step")

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        actuator, cutoff = joint.actuator, 2.0 * math.pi * config.observer_cutoff
        return {
            "stiffness": actuator.stiffness,
            "motor_inertia": actuator.rotor_inertia,
            "motor_damping": actuator.viscous + actuator.damping,
            "observer_cutoff": cutoff,
            "observer_half_step": half_step(cutoff, 1.0 / config.rate),
        }

    @staticmethod
    def _inner(x: Symbols, p: Symbols) -> LowPass:
        return LowPass(x.inner_low, x.inner_rate, p.observer_cutoff, p.observer_half_step)

    @staticmethod
    def _observed(x: Symbols, p: Symbols) -> LowPass:
        return LowPass(x.observed_low, x.observed_rate, p.observer_cutoff, p.observer_half_step)

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        low, rate, acceleration, _ = self._observed(x, p).filter(s.torque)
        stiff = p.stiffness * (1 + gains.kp)
        expected = low + ((p.motor_damping + gains.kd) * rate + p.motor_inertia * acceleration) / stiff
        inner = self._inner(x, p)  # r reaches its own filter's output in the same tick: solved for it
        r = (s.reference - expected + inner.stored) / (1 - inner.at_once)
        return r + gains.kp * (r - s.torque) - gains.kd * s.motor_velocity

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, applied: Applied) -> Symbols:
        effort = applied.effort - applied.excess
        r = (effort + gains.kp * s.torque + gains.kd * s.motor_velocity) / (1 + gains.kp)
        watched = ca.if_else(applied.closed > 0, r, s.torque)  # at rest, what is sensed is what is wanted
        observed, inner = self._observed(x, p).filter(s.torque).next, self._inner(x, p).filter(watched).next
        return Symbols(observed_low=observed[0], observed_rate=observed[1], inner_low=inner[0], inner_rate=inner[1])
