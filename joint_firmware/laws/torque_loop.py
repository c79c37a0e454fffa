"""Torque loops: from the torque that is wanted and the one that is sensed to the motor's effort.

A loop is smooth, so that it can be linearised; saturation is outside. What was applied comes back to ``update``: a loop
that integrates takes its anti-windup from it. All is in equivalent rotary coordinates (``robots.actuators``).
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Block, Symbols, symbols, vector
from joint_firmware.laws.signals import Gains
from robots.description import Joint


class LoopSignals(NamedTuple):
    """What a torque loop sees."""

    reference: ca.SX  # N m
    torque: ca.SX  # N m, sensed
    motor_velocity: ca.SX  # rad/s
    velocity: ca.SX  # rad/s, of the output

    @property
    def error(self) -> ca.SX:
        """N m."""
        return self.reference - self.torque


class Applied(NamedTuple):
    """What has become of a loop's effort."""

    effort: ca.SX  # N m, what the loop gave
    excess: ca.SX | float = 0.0  # N m, what saturation has cut off
    closed: ca.SX | float = 1.0  # 0: the loop is not in force, it only watches

    def winds_up(self, error: ca.SX) -> ca.SX:
        """Whether an integral of ``error`` would drive the effort further beyond its limit."""
        return self.excess * error > 0


class TorqueLoop(Block):
    """Base of the torque loops."""

    name: str
    hydraulic = False  # made for a valve's flow, and not for a motor's torque

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        """Motor torque, N m, before saturation."""
        raise NotImplementedError

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, applied: Applied) -> Symbols:
        """States of the next tick."""
        return Symbols()

    def doubts(self, joint: Joint, config: FirmwareConfig) -> list[str]:
        """A sentence for each of the loop's own conditions that the gains do not meet.

        Raises ValueError, with one sentence, for gains that make the loop unstable by its own theory.
        """
        return []


def loop_function(loop: TorqueLoop) -> ca.Function:
    """``loop`` alone, not saturated: ``(signals[4], gains[3], x, p) -> (x_next, effort)``.

    ``signals`` are those of LoopSignals, ``gains`` those of Gains, ``x`` and ``p`` the loop's ``states`` and
    ``parameters``, all in SI units.
    """
    signals, gains = ca.SX.sym("signals", 4), ca.SX.sym("gains", 3)
    x, p = symbols(loop.states), symbols(loop.parameters)
    s, g = LoopSignals(*ca.vertsplit(signals)), Gains(*ca.vertsplit(gains))
    effort = loop.effort(s, g, x, p)
    x_next = loop.update(s, g, x, p, Applied(effort))
    return ca.Function(
        "torque_loop",
        [signals, gains, vector(x, loop.states), vector(p, loop.parameters)],
        [vector(x_next, loop.states), effort],
        ["signals", "gains", "x", "p"], ["x_next", "effort"],
    )  # fmt: skip
