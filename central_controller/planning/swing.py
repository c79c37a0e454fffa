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


class SwingTrajectory:
    """One swing at a time. Times are the caller's, in s."""

    def __init__(self, config: SwingConfig) -> None:
        self._config = config
        self._restart(0.0, 0.0, (0.0,) * 4, (0.0,) * 4, (0.0,) * 4, 0.0, 0.0)

    def _restart(
        self, start: float, duration: float, x: _Cubic, y: _Cubic, z: _Cubic, sink: float, level: float
    ) -> None:
        self._start, self._duration = start, duration
        self._x, self._y, self._z = x, y, z
        self._sink = sink  # m/s, downwards after the end
        self._level = level  # s, for which z stays as it is at first

    def lift(self, now: float, foot: Foot, duration: float, step_up: float = 0.0) -> None:
        """Begin to lift the foot that rests at ``foot``: x and y stay, z rises by the configured height and by
        ``step_up`` [m] in ``duration`` [s], at rest at the end."""
        rise = self._config.height + step_up
        z = _cubic(foot.z, 0.0, foot.z + rise, 0.0, duration)
        self._restart(now, duration, (foot.x, 0.0, 0.0, 0.0), (foot.y, 0.0, 0.0, 0.0), z, 0.0, 0.0)

    def land(self, now: float, target: Foot, duration: float) -> None:
        """Go from where the trajectory is ``now``, with its velocity, to ``target`` within ``duration`` [s]. May be
        called again while landing: position and velocity stay continuous."""
        x, y, z, vx, vy, vz, *_ = self.at(now)
        sink = self._config.touchdown_speed
        level = self._config.level * duration if vz == 0.0 else 0.0
        self._restart(
            now,
            duration,
            _cubic(x, vx, target.x, 0.0, duration),
            _cubic(y, vy, target.y, 0.0, duration),
            _cubic(z, vz, target.z, -sink, duration - level),
            sink,
            level,
        )

    def at(self, now: float) -> SwingPoint:
        """The set-point. Before the start it is the start, at rest; after the end it sinks at the touch-down speed, by
        ``search_depth`` at most."""
        t = now - self._start
        if t < 0.0:
            return self._x[0], self._y[0], self._z[0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        late = t - self._duration
        if late >= 0.0:
            x, y = (_value(c, self._duration) for c in (self._x, self._y))
            z = _value(self._z, self._duration - self._level)
            depth, sink = late * self._sink, -self._sink
            if depth > self._config.search_depth:
                depth, sink = self._config.search_depth, 0.0
            return x, y, z - depth, 0.0, 0.0, sink, 0.0, 0.0, 0.0
        x0, x1, x2, x3 = self._x
        y0, y1, y2, y3 = self._y
        z0, z1, z2, z3 = self._z
        down = t - self._level
        if down < 0.0:
            down = z1 = z2 = z3 = 0.0
        return (
            x0 + t * (x1 + t * (x2 + t * x3)),
            y0 + t * (y1 + t * (y2 + t * y3)),
            z0 + down * (z1 + down * (z2 + down * z3)),
            x1 + t * (2.0 * x2 + 3.0 * t * x3),
            y1 + t * (2.0 * y2 + 3.0 * t * y3),
            z1 + down * (2.0 * z2 + 3.0 * down * z3),
            2.0 * x2 + 6.0 * t * x3,
            2.0 * y2 + 6.0 * t * y3,
            2.0 * z2 + 6.0 * down * z3,
        )

    def snapshot(self) -> Any:
        return self._start, self._duration, self._x, self._y, self._z, self._sink, self._level

    def restore(self, state: Any) -> None:
        self._restart(*state)


def _cubic(p0: float, v0: float, p1: float, v1: float, duration: float) -> _Cubic:
    """Coefficients, lowest first, of the cubic with these positions and velocities at 0 and at ``duration``."""
    if duration <= 0.0:
        return p1, 0.0, 0.0, 0.0
    t, mean = duration, (p1 - p0) / duration
    return p0, v0, (3.0 * mean - 2.0 * v0 - v1) / t, (v0 + v1 - 2.0 * mean) / (t * t)


def _value(cubic: _Cubic, t: float) -> float:
    a, b, c, d = cubic
    return a + t * (b + t * (c + t * d))
