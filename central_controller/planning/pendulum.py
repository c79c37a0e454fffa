"""The prismatic inverted pendulum: a point foot, a massless leg, a centre of mass that is held on a height surface.

From Kim 2018 (B.1) and (B.4), with q = z_xx vx² + 2 z_xy vx vy + z_yy vy² (what the surface's curvature alone gives):

    x'' = r (x − p_x) (g + z'') / (z − p_z),    y'' = (y − p_y) (g + z'') / (z − p_z)
    z'' = q + z_x x'' + z_y y''
    ⇒ (g + z'') / (z − p_z) = (g + q) / (z − p_z − r z_x (x − p_x) − z_y (y − p_y))

which is (B.8) for r = 1 and p_z = 0. r = M/(M + m_s) < 1 when a slider of mass m_s moves along in x, (7.5).
Scalars only: a plan integrates some hundred steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from central_controller.planning.height_surface import HeightSurface


class PendulumState(NamedTuple):
    """Centre of mass in the world, m and m/s."""

    x: float
    y: float
    vx: float
    vy: float


class Foot(NamedTuple):
    """A point foot in the world, m."""

    x: float
    y: float
    z: float = 0.0


class Pendulum:
    """The pendulum on a surface."""

    def __init__(self, surface: HeightSurface, gravity: float = 9.81, mass_ratio: float = 1.0) -> None:
        """``mass_ratio``: M/(M + m_s) of Kim 2018 (7.5)."""
        self.surface, self.gravity, self.mass_ratio = surface, gravity, mass_ratio

    def acceleration(self, state: PendulumState, foot: Foot) -> tuple[float, float]:
        """(x'', y'') [m/s²] at ``state`` above ``foot``."""
        return self._acceleration(*state, *foot)

    def _acceleration(
        self, x: float, y: float, vx: float, vy: float, px: float, py: float, pz: float
    ) -> tuple[float, float]:
        z, zx, zy, zxx, zxy, zyy = self.surface(x, y)
        r, dx, dy = self.mass_ratio, x - px, y - py
        pull = (self.gravity + zxx * vx * vx + 2.0 * zxy * vx * vy + zyy * vy * vy) / (z - pz - r * zx * dx - zy * dy)
        return r * dx * pull, dy * pull

    def advance(self, state: PendulumState, foot: Foot, duration: float, step: float) -> PendulumState:
        """The state ``duration`` [s] later, by classical Runge-Kutta in equal steps of at most ``step`` [s]."""
        if duration <= 0.0:
            return state
        n = math.ceil(duration / step - 1e-9)
        h = duration / n
        half, sixth = 0.5 * h, h / 6.0
        f = self._acceleration
        x, y, vx, vy = state
        px, py, pz = foot
        for _ in range(n):
            ax1, ay1 = f(x, y, vx, vy, px, py, pz)
            vx2, vy2 = vx + half * ax1, vy + half * ay1
            ax2, ay2 = f(x + half * vx, y + half * vy, vx2, vy2, px, py, pz)
            vx3, vy3 = vx + half * ax2, vy + half * ay2
            ax3, ay3 = f(x + half * vx2, y + half * vy2, vx3, vy3, px, py, pz)
            vx4, vy4 = vx + h * ax3, vy + h * ay3
            ax4, ay4 = f(x + h * vx3, y + h * vy3, vx4, vy4, px, py, pz)
            x += sixth * (vx + 2.0 * (vx2 + vx3) + vx4)
            y += sixth * (vy + 2.0 * (vy2 + vy3) + vy4)
            vx += sixth * (ax1 + 2.0 * (ax2 + ax3) + ax4)
            vy += sixth * (ay1 + 2.0 * (ay2 + ay3) + ay4)
        return PendulumState(x, y, vx, vy)

    def path(self, state: PendulumState, foot: Foot, duration: float, step: float) -> np.ndarray:
        """Rows t, x, y, vx, vy from now until ``duration`` [s] later, every ``step`` [s], for pictures and records."""
        n = max(1, math.ceil(duration / step - 1e-9))
        h = duration / n
        rows = [(0.0, *state)]
        for i in range(1, n + 1):
            state = self.advance(state, foot, h, h)
            rows.append((i * h, *state))
        return np.array(rows)


def on_level(state: PendulumState, foot: Foot, height: float, time: float, gravity: float = 9.81) -> PendulumState:
    """The state ``time`` [s] later on a level surface ``height`` [m] above the foot: Kim 2018 (4.27)."""
    omega = math.sqrt(gravity / height)
    c, s = math.cosh(omega * time), math.sinh(omega * time)
    dx, dy = state.x - foot.x, state.y - foot.y
    return PendulumState(
        foot.x + c * dx + s / omega * state.vx,
        foot.y + c * dy + s / omega * state.vy,
        omega * s * dx + c * state.vx,
        omega * s * dy + c * state.vy,
    )
