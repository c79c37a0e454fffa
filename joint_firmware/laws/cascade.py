"""Torque control around an inner loop of the motor's velocity, passive at the joint (Kim 2018 §7.3.1).

Vallery, Ekkelenkamp, van der Kooij, Buss, "Passive and accurate torque control of series elastic actuators", IROS 2007:
a PI of the torque error gives the motor's desired velocity, a PI of the velocity error the motor's torque,

    w_d = P_t e + I_t ∫e,      effort = P_v (w_d − dphi) + I_v ∫(w_d − dphi),      e = tau_d − tau

In the gains of the other loops, kp = P_v P_t, ki = P_v I_t, kd = P_v, and w_i = I_v / P_v [1/s] beside them:

    v = kp e + ki ∫e − kd dphi,      effort = v + w_i ∫v

Seen from the joint, with a rotor J of friction b on a spring k, the actuator at tau_d = 0 is the admittance

    −dq / tau = s/k + (n2 s² + n1 s + n0) / (s (J s² + (b + kd) s + w_i kd)),
    n2 = 1 + kp,      n1 = ki + w_i kp,      n0 = w_i ki

Its real part on the imaginary axis is not negative at any frequency, the joint passive, if and only if

    low frequencies:   w_i (w_i kp kd − ki b) ≥ 0
    high frequencies:  (1 + kp)(b + kd) ≥ J (ki + w_i kp)
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from joint_firmware.config import FirmwareConfig, TorqueGains
from joint_firmware.laws.block import Offsets, Symbols
from joint_firmware.laws.pid_m import integrated
from joint_firmware.laws.signals import Gains
from joint_firmware.laws.torque_loop import Applied, LoopSignals, TorqueLoop
from robots.description import Joint

_FADE_S = 0.1  # time constant of an inner integral whose gain is gone


class Cascade(TorqueLoop):
    name = "cascade"
    states = ("integral", "velocity_integral")
    parameters = ("dt", "velocity_integral_gain")

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {"dt": 1.0 / config.rate, "velocity_integral_gain": config.velocity_integral}

    @staticmethod
    def _velocity_error(s: LoopSignals, gains: Gains, x: Symbols) -> ca.SX:
        """v, N m."""
        return gains.kp * s.error + ca.if_else(gains.ki > 0, x.integral, 0) - gains.kd * s.motor_velocity

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        return self._velocity_error(s, gains, x) + x.velocity_integral

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, applied: Applied) -> Symbols:
        inner = self._velocity_error(s, gains, x)  # its gain comes with no command: no change of it is carried on
        return Symbols(
            integral=integrated(x.integral, gains.ki, s.error, p.dt, applied),
            velocity_integral=integrated(
                x.velocity_integral,
                p.velocity_integral_gain,
                inner,
                p.dt,
                applied,
                without_gain=x.velocity_integral * (1 - p.dt / _FADE_S),
            ),
        )

    def doubts(self, joint: Joint, config: FirmwareConfig) -> list[str]:
        found = []
        for which in ("stance", "swing"):
            gains: TorqueGains = getattr(config, which)
            place = f"{joint.name}, firmware.{which}"
            if not stable(joint, gains, config.velocity_integral):
                raise ValueError(
                    f"{place}: the cascade with kp = {gains.kp:g}, ki = {gains.ki:g} 1/s, kd = {gains.kd:g} "
                    f"N m s/rad and velocity_integral = {config.velocity_integral:g} 1/s is unstable with the joint "
                    "held: raise kd, or lower ki or velocity_integral"
                )
            found += [f"{place}: {reason}" for reason in not_passive(joint, gains, config.velocity_integral)]
        return found


def not_passive(joint: Joint, gains: TorqueGains, velocity_integral: float) -> list[str]:
    """What keeps the joint from being passive in continuous time, a sentence each."""
    kp, ki, kd, wi = gains.kp, gains.ki, gains.kd, velocity_integral
    b, inertia = joint.actuator.viscous, joint.actuator.rotor_inertia
    found = []
    if wi * (wi * kp * kd - ki * b) < 0:
        found.append(
            f"the cascade is not passive at low frequencies: ki = {ki:g} 1/s, expected at most "
            f"{wi * kp * kd / b:.4g} 1/s (velocity_integral kp kd / b)"
        )
    bound = (1 + kp) * (b + kd) / inertia
    if ki + wi * kp > bound:
        found.append(
            f"the cascade is not passive at high frequencies: ki + velocity_integral kp = {ki + wi * kp:.4g} 1/s, "
            f"expected at most {bound:.4g} 1/s ((1 + kp)(b + kd) / J)"
        )
    return found


def stable(joint: Joint, gains: TorqueGains, velocity_integral: float) -> bool:
    """Whether the loop is stable in continuous time with its output held."""
    a, wi = joint.actuator, velocity_integral
    polynomial = [
        a.rotor_inertia,
        a.viscous + a.damping + gains.kd,
        wi * gains.kd + a.stiffness * (1 + gains.kp),
        a.stiffness * (gains.ki + wi * gains.kp),
        a.stiffness * wi * gains.ki,
    ]
    while polynomial[-1] == 0:  # an integral that is not there
        polynomial.pop()
    return bool(np.all(np.roots(polynomial).real < 0))
