"""The law of a drive, one CasADi function: what is emulated here is what a DSP would run.

    sensing → monitor → reference → torque loop → saturation and rounding

All quantities are as seen from the joint; sizes are fixed; integers are exact in doubles. A change of gains is
bumpless: what it would move the motor by is carried on, and fades unless the loop integrates.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from bus.messages import AMPERE, MOTOR_RADIAN_PER_SECOND, NEWTON_METRE, RADIAN, RADIAN_PER_SECOND
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as s
from joint_firmware.laws.block import Block, Offsets, Symbols, clip, symbols, vector
from joint_firmware.laws.catalogue import TORQUE_LOOPS
from joint_firmware.laws.monitor import Monitor
from joint_firmware.laws.reference import Reference
from joint_firmware.laws.sensing import Sensing
from joint_firmware.laws.torque_loop import LoopSignals
from robots import pins
from robots.description import Joint

_I32, _I16 = 2**31 - 1, 2**15 - 1
_FADE_S = 0.1  # time constant


class Output(Block):
    """Around the torque loop: what was in force in the tick before, and the power stage."""

    states = ("kp", "ki", "kd", "carry", "demanded")
    parameters = ("dt", "torque_per_ampere", "current_limit", "quick_stop_damping")

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {
            "dt": 1.0 / config.rate,
            "torque_per_ampere": joint.actuator.torque_per_ampere,
            "current_limit": joint.actuator.current_limit,
            "quick_stop_damping": config.quick_stop_damping,
        }


class DriveLaw:
    """The law whose torque loop is ``loop``.

    ``function`` is ``(counts, x, u, p) -> (x_next, y)``; counts, u and y as in ``laws.signals``, x and p in the
    order of ``states`` and ``parameters``.
    """

    def __init__(self, loop: str) -> None:
        self._sensing, self._monitor, self._reference = Sensing(), Monitor(), Reference()
        self._loop, self._output = TORQUE_LOOPS[loop], Output()
        self._blocks: tuple[Block, ...] = (
            self._sensing, self._monitor, self._reference, self._loop, self._output
        )  # fmt: skip
        self.states = tuple(name for block in self._blocks for name in block.states)
        self.parameters = tuple(dict.fromkeys(name for block in self._blocks for name in block.parameters))
        if len(set(self.states)) < len(self.states):
            raise AssertionError(f"two blocks have a state of the same name: {self.states}")
        self.function = self._assemble()

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets = Offsets()) -> np.ndarray:
        """The parameter vector of ``joint``'s drive."""
        values: dict[str, float] = {}
        for block in self._blocks:
            values.update(block.values(joint, config, offsets))
        return np.array([values[name] for name in self.parameters])

    def _assemble(self) -> ca.Function:
        counts, u_given = ca.SX.sym("counts", s.COUNTS_SIZE), ca.SX.sym("u", s.INPUT_SIZE)
        x, p = symbols(self.states), symbols(self.parameters)
        sensed, sensing_next = self._sensing.sense(counts, x, p)
        u, misled = self._monitor.admit(u_given, p)
        verdict, monitor_next = self._monitor.watch(counts, u, misled, sensed, x, p)
        wanted, reference_next = self._reference.follow(u, sensed, x, p)

        gains, before = s.Gains(u[s.U_KP], u[s.U_KI], u[s.U_KD]), s.Gains(x.kp, x.ki, x.kd)
        seen = LoopSignals(wanted.torque, sensed.torque, sensed.motor_velocity, sensed.velocity)
        linear = self._loop.effort(seen, gains, x, p)
        bump = ca.if_else(x.active > 0, self._loop.effort(seen, before, x, p) - linear, 0)
        carry = x.carry + bump
        effort = linear + carry

        braking = -p.quick_stop_damping * sensed.motor_velocity
        demand = wanted.active * effort + u[s.U_DAMPING_MODE] * braking
        demand = ca.if_else(verdict.power_off, 0, ca.if_else(verdict.brake, wanted.active * braking, demand))
        current = demand / p.torque_per_ampere
        saturated = clip(current, -p.current_limit, p.current_limit)
        cut = ca.fabs(current) > p.current_limit
        applied = ca.if_else(cut, saturated * p.torque_per_ampere, effort)
        loop_next = self._loop.update(seen, gains, x, p, effort, applied)

        fading = 1 - self._loop.integrates(gains)
        running = {**vars(loop_next), **gains._asdict(), "carry": carry * (1 - fading * p.dt / _FADE_S)}
        x_next = Symbols(
            **vars(sensing_next), **vars(monitor_next), **vars(reference_next),
            **{name: wanted.active * value for name, value in running.items()}, demanded=saturated,
        )  # fmt: skip
        y = ca.vertcat(
            _round(sensed.position / RADIAN, _I32),
            _round(sensed.velocity / RADIAN_PER_SECOND, _I32),
            _round(sensed.torque / NEWTON_METRE, _I32),
            _round(counts[pins.CURRENT_ADC] * pins.AMPERE_PER_COUNT / AMPERE, _I16),
            _round(sensed.motor_velocity / MOTOR_RADIAN_PER_SECOND, _I16),
            _round(saturated / pins.AMPERE_PER_COUNT, _I32),
            wanted.active * ca.logic_or(wanted.limited, cut),
            sensed.torque,
            sensed.position,
            verdict.trips,
        )
        arguments = [counts, vector(x, self.states), u_given, vector(p, self.parameters)]
        names = ["counts", "x", "u", "p"]
        self.levels = ca.Function("levels", arguments, [verdict.levels], names, ["levels"])
        return ca.Function("joint_law", arguments, [vector(x_next, self.states), y], names, ["x_next", "y"])


def _round(value: ca.SX, limit: int) -> ca.SX:
    """``value`` rounded, within ±``limit``: a wild sensor must not overflow a field of the message."""
    return clip(ca.floor(value + 0.5), -limit, limit)


@cache
def _drive_law(loop: str) -> DriveLaw:
    return DriveLaw(loop)


def drive_law(joint: Joint, config: FirmwareConfig) -> DriveLaw:
    """The law of ``joint``'s drive; joints whose laws differ by parameters only share one."""
    return _drive_law(config.law)
