"""The swing foot's way: straight up, then a cubic to where it lands, then slowly on down if the ground is late.

Kim 2018 §7.3.2: "first reaching a predefined z height while keeping x and y constant. Then, a 3rd order polynomial is
used to generate the desired (x, y, z) landing trajectory".
"""

from __future__ import annotations

from typing import Any

from central_controller.planning.config import SwingConfig
from central_controller.planning.pendulum import Foot

# x, y, z [m], their velocities [m/s], their accelerations [m/s²]
SwingPoint = tuple[float, float, float, float, float, float, float, float, float]
_Cubic = tuple[float, float, float, float]
_Across = tuple[float, float, _Cubic, _Cubic]  # since when, for how long [s], x and y
# since when, for how long [s], z, downwards after the end [m/s], for how long z stays as it is at first [s]
_Upright = tuple[float, float, _Cubic, float, float]


class SwingTrajectory:
    """One swing at a time. Times are the caller's, in s."""

    def __init__(self, config: SwingConfig) -> None:
        self._config = config
        rest = (0.0,) * 4
        self._across: _Across = (0.0, 0.0, rest, rest)
        self._upright: _Upright = (0.0, 0.0, rest, 0.0, 0.0)

    def lift(self, now: float, foot: Foot, duration: float, step_up: float = 0.0) -> None:
        """Begin to lift the foot that rests at ``foot``: x and y stay, z rises by the configured height and by
        ``step_up`` [m] in ``duration`` [s], at rest at the end."""
        rise = self._config.height + step_up
        self._across = now, duration, (foot.x, 0.0, 0.0, 0.0), (foot.y, 0.0, 0.0, 0.0)
        self._upright = now, duration, _cubic(foot.z, 0.0, foot.z + rise, 0.0, duration), 0.0, 0.0

    def aim(self, now: float, target: Foot, duration: float) -> None:
        """Go in x and y from where the trajectory is ``now``, with its velocity, to ``target`` within ``duration``
        [s]; z stays what it was. May be called again: position and velocity stay continuous."""
        x, y, _, vx, vy, *_ = self.at(now)
        self._across = now, duration, _cubic(x, vx, target.x, 0.0, duration), _cubic(y, vy, target.y, 0.0, duration)

    def land(self, now: float, target: Foot, duration: float) -> None:
        """As ``aim``, and go down to the ground at ``target`` as well."""
        _, _, z, _, _, vz, *_ = self.at(now)
        self.aim(now, target, duration)
        sink = self._config.touchdown_speed
        level = self._config.level * duration if vz == 0.0 else 0.0
        self._upright = now, duration, _cubic(z, vz, target.z, -sink, duration - level), sink, level

    def at(self, now: float) -> SwingPoint:
        """The set-point. Before the start it is the start, at rest; after the end it sinks at the touch-down speed, by
        ``search_depth`` at most."""
        start, duration, (x0, x1, x2, x3), (y0, y1, y2, y3) = self._across
        t = min(duration, max(0.0, now - start))
        x, vx, ax = x0 + t * (x1 + t * (x2 + t * x3)), x1 + t * (2.0 * x2 + 3.0 * t * x3), 2.0 * x2 + 6.0 * t * x3
        y, vy, ay = y0 + t * (y1 + t * (y2 + t * y3)), y1 + t * (2.0 * y2 + 3.0 * t * y3), 2.0 * y2 + 6.0 * t * y3
        if not start <= now < start + duration:
            vx = vy = ax = ay = 0.0
        start, duration, (z0, z1, z2, z3), sink, level = self._upright
        t = min(duration, now - start)
        down = t - level
        if down < 0.0:
            return x, y, z0, vx, vy, 0.0, ax, ay, 0.0
        z = z0 + down * (z1 + down * (z2 + down * z3))
        late = now - start - duration
        if late < 0.0:
            return x, y, z, vx, vy, z1 + down * (2.0 * z2 + 3.0 * down * z3), ax, ay, 2.0 * z2 + 6.0 * down * z3
        depth, speed = late * sink, -sink
        if depth > self._config.search_depth:
            depth, speed = self._config.search_depth, 0.0
        return x, y, z - depth, vx, vy, speed, ax, ay, 0.0

    def snapshot(self) -> Any:
        return self._across, self._upright

    def restore(self, state: Any) -> None:
        self._across, self._upright = state


def _cubic(p0: float, v0: float, p1: float, v1: float, duration: float) -> _Cubic:
    """Coefficients, lowest first, of the cubic with these positions and velocities at 0 and at ``duration``."""
    if duration <= 0.0:
        return p1, 0.0, 0.0, 0.0
    t, mean = duration, (p1 - p0) / duration
    return p0, v0, (3.0 * mean - 2.0 * v0 - v1) / t, (v0 + v1 - 2.0 * mean) / (t * t)
