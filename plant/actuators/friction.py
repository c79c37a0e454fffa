"""Dry friction in a time step: set-valued and implicit, it neither creeps nor reverses a motion."""

from __future__ import annotations

from typing import Any

import casadi as ca

STRIBECK_VELOCITY = 0.02  # rad/s at the joint: friction falls from static to sliding over this


def sign(value: Any) -> Any:
    return ca.if_else(value > 0, 1, ca.if_else(value < 0, -1, 0))


def slide(
    velocity: Any, net: Any, inertia: Any, dt: float, coulomb: Any, static: Any, viscous: Any,
    stribeck: float = STRIBECK_VELOCITY,
) -> Any:  # fmt: skip
    """Velocity after a step under ``net``, the sum of what acts without friction.

    At rest it stays exactly there up to ``static``; a sliding body is slowed, never reversed, by the friction of a
    step.
    """
    resting = coulomb + (static - coulomb) * ca.exp(-((velocity / stribeck) ** 2))
    # at rest, what exceeds the static level starts the motion, against sliding friction from then on
    free = velocity + dt * net / inertia
    level = ca.if_else(velocity == 0, coulomb, resting)
    slowed = sign(free) * ca.fmax(ca.fabs(free) - dt * level / inertia, 0)
    moving = slowed / (1 + dt * viscous / inertia)
    held = ca.logic_and(velocity == 0, ca.fabs(net) <= static)
    return ca.if_else(held, 0, moving)
