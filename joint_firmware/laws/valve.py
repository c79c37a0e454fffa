"""Force control of a hydraulic joint by its valve (Rotella 2018 §II.1),

    u = PID(F, F_des) + k_vc dx_piston + b

in equivalent rotary coordinates: F r0 is the effort, dx / r0 the piston's velocity. The derivative is that of the
sensed force alone, filtered as in PD_f. A valve gives flow: k_vc opens it as far as the moving piston swallows, at the
pressure drop of an unloaded piston, times the configured share. A constant gain turns effort into the valve's current.
"""

from __future__ import annotations

import math

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Offsets, Symbols
from joint_firmware.laws.pd_f import TorqueRate
from joint_firmware.laws.pid_m import integrated
from joint_firmware.laws.signals import Gains
from joint_firmware.laws.torque_loop import Applied, LoopSignals
from robots.actuators import Hydraulic
from robots.description import Joint


class Valve(TorqueRate):
    name = "valve"
    hydraulic = True
    states: tuple[str, ...] = ("integral", *TorqueRate.states)
    parameters: tuple[str, ...] = ("dt", *TorqueRate.parameters, "velocity_compensation", "valve_bias")

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {
            **super().values(joint, config, offsets),
            "dt": 1.0 / config.rate,
            "velocity_compensation": config.velocity_compensation * current_per_velocity(joint)
            * joint.actuator.torque_per_ampere,
            "valve_bias": config.valve_bias * joint.actuator.torque_per_ampere,
        }  # fmt: skip

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        pid = gains.kp * s.error + ca.if_else(gains.ki > 0, x.integral, 0) - self._damping(s, gains, x, p)
        return pid + p.velocity_compensation * s.motor_velocity + p.valve_bias

    def _damping(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        return gains.kd / p.stiffness * self.filtered(s, x, p).rate

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, applied: Applied) -> Symbols:
        low, rate = self.filtered(s, x, p).next
        integral = integrated(x.integral, gains.ki, s.error, p.dt, applied)
        return Symbols(integral=integral, torque_low=low, torque_rate=rate)


def current_per_velocity(joint: Joint) -> float:
    """Valve current that feeds the moving piston with no force on it, A s/rad; 0 for an actuator without a valve.

    The drop of an unloaded piston is shared evenly by the valve's two edges.
    """
    actuator = joint.actuator
    if not isinstance(actuator, Hydraulic):
        return 0.0
    drop = 0.5 * (actuator.supply_pressure - actuator.return_pressure)
    area = 0.5 * (actuator.piston_area + actuator.rod_area)
    flow = actuator.valve_flow * math.sqrt(drop / actuator.valve_drop)  # at rated current
    return area * actuator.nominal_arm * actuator.current_limit / flow
