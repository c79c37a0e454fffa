"""Surfaces z = h(x, y) that a centre of mass is held on.

A surface is called with x, y [m] in the world and returns ``Height``: value and derivatives, plain floats, since the
pendulum asks for it some hundred times per plan.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence

from robots.terrain import Block

# z [m], z_x, z_y, z_xx, z_xy, z_yy [1/m]
Height = tuple[float, float, float, float, float, float]
HeightSurface = Callable[[float, float], Height]


class Plane:
    """z = height + slope_x x + slope_y y; flat when no slope is given."""

    def __init__(self, height: float, slope_x: float = 0.0, slope_y: float = 0.0) -> None:
        self._height, self._slope_x, self._slope_y = height, slope_x, slope_y
        self._flat = (height, 0.0, 0.0, 0.0, 0.0, 0.0) if slope_x == slope_y == 0.0 else None

    def __call__(self, x: float, y: float) -> Height:
        if self._flat is not None:
            return self._flat
        a, b = self._slope_x, self._slope_y
        return self._height + a * x + b * y, a, b, 0.0, 0.0, 0.0


class CosineProfile:
    """Heights at places along x, joined by half waves of a cosine; constant before the first and behind the last.

    The slope is zero at every place, so the surface is continuous to first order whatever the heights. Two places of
    one height have a level piece between them.
    """

    def __init__(self, places: Sequence[tuple[float, float]]) -> None:
        """``places``: (x, z) [m] in ascending x. Raises ValueError."""
        self._x = [x for x, _ in places]
        self._z = [z for _, z in places]
        if not places or any(after <= before for before, after in zip(self._x, self._x[1:], strict=False)):
            raise ValueError(f"the places of a profile need ascending x, got {', '.join(f'{x:g}' for x in self._x)} m")

    @property
    def places(self) -> list[tuple[float, float]]:
        return list(zip(self._x, self._z, strict=True))

    def __call__(self, x: float, y: float) -> Height:
        xs, zs = self._x, self._z
        i = bisect_right(xs, x)
        if i == 0 or i == len(xs):
            return zs[i and -1], 0.0, 0.0, 0.0, 0.0, 0.0
        left, z = xs[i - 1], zs[i - 1]
        half = 0.5 * (zs[i] - z)
        if half == 0.0:
            return z, 0.0, 0.0, 0.0, 0.0, 0.0
        k = math.pi / (xs[i] - left)
        angle = k * (x - left)
        cosine = half * math.cos(angle)
        return z + half - cosine, k * half * math.sin(angle), 0.0, k * k * cosine, 0.0, 0.0


def platform(height: float, rise: float, start: float, end: float, ramp: float) -> CosineProfile:
    """Three level pieces joined by two sinusoidal segments (Kim 2018 §4.3.1, Fig. 4.14).

    Args:
        height: of the outer pieces [m].
        rise: of the middle piece above them [m].
        start, end: the middle piece [m].
        ramp: length of either segment [m].
    """
    low, high = height, height + rise
    return CosineProfile([(start - ramp, low), (start, high), (end, high), (end + ramp, low)])


def over_blocks(height: float, blocks: Iterable[Block], ramp: float) -> HeightSurface:
    """The level ``height`` [m], raised over each block by the block's; half of each ``ramp`` [m] lies on the block.

    Raises ValueError when blocks are shorter or closer than a ramp.
    """
    places: list[tuple[float, float]] = []
    for block in sorted(blocks, key=lambda block: block.start):
        places += platform(height, block.height, block.start + ramp / 2, block.end - ramp / 2, ramp).places
    return CosineProfile(places) if places else Plane(height)


def vault(x_i: float, z_i: float, h_o: float, x_f: float, z_f: float) -> CosineProfile:
    """The height of one step, relative to its stance foot at x = 0: from z_i at x_i up to z_i + h_o above the foot and
    down to z_f at x_f, where it lands softly (Kim 2018 (7.6), (7.7)).

    In print the cosine of (7.6) lacks x_i in its argument's numerator, and its curvature has x_f where x_i belongs.
    """
    return CosineProfile([(x_i, z_i), (0.0, z_i + h_o), (x_f, z_f)])
