"""Where the swing foot can be put."""

from __future__ import annotations

import math
from collections.abc import Iterable

from central_controller.planning.config import ReachConfig
from central_controller.planning.pendulum import Foot
from robots.terrain import Block

RIGHT, LEFT = -1, 1  # sides, as the sign of y


def nearest_reachable(
    config: ReachConfig, side: int, wanted: tuple[float, float], stance: Foot, hips: tuple[float, float]
) -> tuple[float, float]:
    """The point next to ``wanted`` (x, y) [m] that the foot of ``side`` can reach: Kim 2018 §4.3.1, "the closest
    reachable step". ``hips``: the middle between the hips when the foot lands.

    Two boxes with parallel sides: the nearest point of what they share is found axis by axis. When they share nothing,
    because the hips have left the stance foot far behind, the box about the stance foot counts: legs must not cross.
    """
    x = _clamp(wanted[0], hips[0] - config.hip_forward, hips[0] + config.hip_forward)
    x = _clamp(x, stance.x - config.forward, stance.x + config.forward)
    hip = side * hips[1] + config.hip_half_width  # y counted outwards from here on
    out = _clamp(side * wanted[1], hip - config.hip_inward, hip + config.hip_outward)
    base = side * stance.y
    out = _clamp(out, base + config.lateral_min, base + config.lateral_max)
    return x, side * out


def clear_of_edges(blocks: Iterable[Block], x: float, clearance: float) -> float:
    """The place next to ``x`` that is ``clearance`` away from each block's edges, on the side on which ``x`` is [m]."""
    for block in blocks:
        for edge in (block.start, block.end):
            if abs(x - edge) < clearance:
                return edge + math.copysign(clearance, x - edge)
    return x


def _clamp(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value
