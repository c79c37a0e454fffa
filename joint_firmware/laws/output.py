"""From the torque loop to the power stage: changes without a bump, saturation, the demand.

Two kinds of change would let the motor jump. Where gains change, or the torque loop closes or opens, what the change
would move the motor by is carried on: it fades, unless the loop integrates, which then holds it as it would its own.
Where a mode begins or ceases to control, or brakes, the demand runs from where it was at ``torque_rate``, but no slower
than from full effort to none in 10 ms. A drive whose operation is not enabled, as in a quick stop, takes no such time,
nor does one whose monitor asks for no current or for braking.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as s
from joint_firmware.laws.block import Block, Offsets, Symbols, clip
from joint_firmware.laws.monitor import Verdict
from joint_firmware.laws.reference import Wanted
from joint_firmware.laws.torque_loop import Applied, LoopSignals, TorqueLoop
from robots.description import Joint

_FADE_S = 0.01  # time constant
_STOP_S = 0.01
_MOST_CARRIED = 4.0  # times full effort


class Demand(NamedTuple):
    """What the power stage is asked for."""

    current: ca.SX  # A
    cut: ca.SX  # whether it is at its limit


class Output(Block):
    """Around the torque loop ``loop``, whose states are among its own."""

    def __init__(self, loop: TorqueLoop) -> None:
        self._loop = loop
        own = ("kp", "ki", "kd", "closed", "carry", "regime", "demand", "ramp")
        self.states = (*loop.states, *own)
        self.parameters = (
            *loop.parameters, "dt", "torque_per_ampere", "current_limit", "quick_stop_damping", "ramp_step",
        )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        actuator, dt = joint.actuator, 1.0 / config.rate
        return {
            **self._loop.values(joint, config, offsets),
            "dt": dt,
            "torque_per_ampere": actuator.torque_per_ampere,
            "current_limit": actuator.current_limit,
            "quick_stop_damping": config.quick_stop_damping,
            "ramp_step": dt * max(config.torque_rate, actuator.current_limit * actuator.torque_per_ampere / _STOP_S),
        }

    def drive(
        self, u: ca.SX, sensed: s.Sensed, wanted: Wanted, verdict: Verdict, x: Symbols, p: Symbols
    ) -> tuple[Demand, Symbols]:
        """The demand, and the states of the next tick."""
        gains, before = s.Gains(u[s.U_KP], u[s.U_KI], u[s.U_KD]), s.Gains(x.kp, x.ki, x.kd)
        seen = LoopSignals(wanted.effort, sensed.effort, sensed.motor_velocity, sensed.output_velocity)
        effort = self._loop.effort(seen, gains, x, p)
        now = ca.if_else(wanted.closed > 0, effort, wanted.effort)
        as_before = ca.if_else(x.closed > 0, self._loop.effort(seen, before, x, p), wanted.effort)
        full = p.current_limit * p.torque_per_ampere
        # a change of gains can mean several times what the motor gives; a sensor's jump in its tick is not carried on
        most = _MOST_CARRIED * full
        carry = clip(x.carry + ca.if_else(x.active > 0, as_before - now, 0), -most, most)

        brake = -p.quick_stop_damping * sensed.motor_velocity
        aim = wanted.active * (now + carry) + u[s.U_DAMPING_MODE] * brake
        within = clip(aim, -full, full)
        regime = wanted.active + 2 * u[s.U_DAMPING_MODE]
        ramp = ca.if_else(regime != x.regime, x.demand - within, x.ramp)
        ramp = u[s.U_ENABLED] * (ramp - clip(ramp, -p.ramp_step, p.ramp_step))
        demand = clip(within + ramp, -full, full)
        braked = wanted.active * clip(brake, -full, full)
        demand = ca.if_else(verdict.power_off, 0, ca.if_else(verdict.brake, braked, demand))
        after = self._loop.update(seen, gains, x, p, Applied(effort, aim - within, wanted.closed))
        states = Symbols(
            **vars(after), **gains._asdict(), closed=wanted.closed,
            carry=wanted.active * carry * (1 - p.dt / _FADE_S), regime=regime, demand=demand, ramp=ramp,
        )  # fmt: skip
        return Demand(demand / p.torque_per_ampere, within != aim), states
