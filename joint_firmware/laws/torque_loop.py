"""Torque loops: from the torque that is wanted and the one that is sensed to the motor's effort.

A loop is smooth, so that it can be linearised; saturation is outside. What was applied comes back to ``update``: a loop
that integrates takes its anti-windup from it.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from joint_firmware.laws.block import Block, Symbols, symbols, vector
from joint_firmware.laws.signals import Gains


class LoopSignals(NamedTuple):
    """What a torque loop sees."""

    reference: ca.SX  # N m
    torque: ca.SX  # N m, sensed
    motor_velocity: ca.SX  # rad/s
    velocity: ca.SX  # rad/s, of the joint


class TorqueLoop(Block):
    """Base of the torque loops."""

    name: str

    def effort(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols) -> ca.SX:
        """Motor torque seen from the joint, N m, before saturation."""
        raise NotImplementedError

    def integrates(self, gains: Gains) -> ca.SX | float:
        """Whether the loop takes away a constant offset of its effort (0 or 1)."""
        return 0.0

    def update(self, s: LoopSignals, gains: Gains, x: Symbols, p: Symbols, effort: ca.SX, applied: ca.SX) -> Symbols:
        """States of the next tick, when of ``effort`` only ``applied`` has acted."""
        return Symbols()


def loop_function(loop: TorqueLoop) -> ca.Function:
    """``loop`` alone, not saturated: ``(signals[4], gains[3], x, p) -> (x_next, effort)``.

    ``signals`` are those of LoopSignals, ``gains`` those of Gains, ``x`` and ``p`` the loop's ``states`` and
    ``parameters``, all in SI units.
    """
    signals, gains = ca.SX.sym("signals", 4), ca.SX.sym("gains", 3)
    x, p = symbols(loop.states), symbols(loop.parameters)
    s, g = LoopSignals(*ca.vertsplit(signals)), Gains(*ca.vertsplit(gains))
    effort = loop.effort(s, g, x, p)
    x_next = loop.update(s, g, x, p, effort, effort)
    return ca.Function(
        "torque_loop",
        [signals, gains, vector(x, loop.states), vector(p, loop.parameters)],
        [vector(x_next, loop.states), effort],
        ["signals", "gains", "x", "p"], ["x_next", "effort"],
    )  # fmt: skip


def winding(s: LoopSignals, effort: ca.SX, applied: ca.SX) -> ca.SX:
    """Whether the effort is cut off, and the torque error would drive it further beyond its limit."""
    return (effort - applied) * (s.reference - s.torque) > 0
