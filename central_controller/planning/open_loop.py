"""Steps planned beforehand as joint angles over time: Kim 2018 §7.1, without any feedback from above the joints.

The centre of mass follows, in phase space, the pendulum of each stance foot with its given speed above the foot; two
feet's paths meet where both have the same speed, and there the stance foot changes. The pendulum drags the planarizer's
slider along, (7.5), on a height that rises above each foot and sinks where the next one lands, (7.6), (7.7). On both
feet before the first and after the last step a polynomial brings it up to speed and to rest. With the feet's ways, the
legs' inverse kinematics give the joint angles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from central_controller.planning.config import OpenLoopConfig
from central_controller.planning.height_surface import CosineProfile
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.planar import PlanarBiped
from robots.description import Robot
from robots.terrain import Block, ground_height

RIGHT_FOOT, LEFT_FOOT = 0, 1  # indices among the robot's feet
_GRID = 0.004  # s, of the inverse kinematics
_X_STEP = 5e-4  # m, in phase space


class Swing(NamedTuple):
    """One foot's way through the air."""

    foot: int  # that swings
    lift_off: float  # s
    landing: float  # s
    start: tuple[float, float]  # x, z [m]
    end: tuple[float, float]


class Motion(NamedTuple):
    """The plan in samples, from the start of the motion; world's axes, origin between the feet's centres."""

    times: np.ndarray  # (n,) s
    positions: np.ndarray  # (n, joints) rad
    velocities: np.ndarray  # (n, joints) rad/s
    torques: np.ndarray  # (n, joints) N m, of legs without weight
    com: np.ndarray  # (n, 2) x, z [m]
    com_velocity: np.ndarray  # (n, 2)
    pressure: np.ndarray  # (n,) x of the centre of pressure that the plan needs [m]
    feet: np.ndarray  # (n, 2, 2) right, left; x, z [m]
    swings: list[Swing]


def plan(robot: Robot, config: OpenLoopConfig, rate: float, blocks: Sequence[Block] = ()) -> Motion:
    """Plan the whole motion over ``blocks``, sampled at ``rate`` [Hz].

    Raises ValueError, in one sentence, when the robot cannot do it: a foot out of reach of its hip, or, on both feet,
    a centre of pressure that is not between them.
    """
    times, x, swings = _along(robot, config, blocks)
    height = _surface(config, blocks)
    fine = np.arange(0.0, times[-1] + 0.5, _GRID)
    spline = CubicSpline(*_distinct(times, x), bc_type="clamped")
    inside = np.minimum(fine, times[-1])
    com_x = spline(inside)
    moving = fine < times[-1]
    speed, acceleration = spline(inside, 1) * moving, spline(inside, 2) * moving
    heights = np.array([height(value, 0.0) for value in com_x.tolist()])
    z = heights[:, 0]
    dz = heights[:, 1] * speed
    ddz = heights[:, 3] * speed**2 + heights[:, 1] * acceleration
    feet = np.array([_feet(config, blocks, swings, time) for time in fine.tolist()])
    ratio = robot.mass / (robot.mass + config.slider_mass)
    vertical = robot.mass * (robot.gravity + ddz)
    horizontal = robot.mass / ratio * acceleration
    pressure = com_x - z * horizontal / vertical

    biped, n = PlanarBiped(robot), len(robot.joints)
    positions, torques = np.zeros((len(fine), n)), np.zeros((len(fine), n))
    for i, time in enumerate(fine.tolist()):
        here = [tuple(foot) for foot in feet[i].tolist()]
        positions[i], torso = biped.posture((float(com_x[i]), float(z[i])), here)  # raises ValueError
        shares = _shares(swings, time, float(pressure[i]), here)
        forces = [(share * float(horizontal[i]), share * float(vertical[i])) for share in shares]
        torques[i] = biped.torques(torso, 0.0, positions[i].tolist(), here, forces)
    ticks = np.arange(0.0, fine[-1], 1.0 / rate)
    joints = CubicSpline(fine, positions)
    return Motion(
        ticks, joints(ticks), joints(ticks, 1), _sampled(ticks, fine, torques),
        _sampled(ticks, fine, np.column_stack([com_x, z])), _sampled(ticks, fine, np.column_stack([speed, dz])),
        np.interp(ticks, fine, pressure), _sampled(ticks, fine, feet.reshape(-1, 4)).reshape(-1, 2, 2), swings,
    )  # fmt: skip


def footholds(config: OpenLoopConfig, blocks: Sequence[Block] = ()) -> list[tuple[float, float]]:
    """(x, z) [m] of the feet's centres in the order in which they come to stand: left, right, then the steps."""
    places = [(n - 0.5) * config.step_length for n in range(config.steps + 2)]
    return [(x, ground_height(blocks, x)) for x in places]


def _surface(config: OpenLoopConfig, blocks: Sequence[Block]) -> CosineProfile:
    """The centre of mass's height over x: half a block's height more above a foot on it."""
    feet = footholds(config, blocks)
    base, first = config.com_height, feet[1][0] - config.lift_off
    places = [(first, base)]
    for n in range(1, config.steps + 1):
        (x, z), (x_next, z_next) = feet[n], feet[n + 1]
        places.append((x, base + 0.5 * z + config.rise))
        landing = x + config.last_landing if n == config.steps else 0.5 * (x + x_next)
        places.append((landing, base + 0.25 * (z + z_next) - config.drop))
    return CosineProfile(places)


class _PhasePath:
    """Speed over x on one stance foot."""

    def __init__(self, pendulum: Pendulum, foot: Foot, apex_speed: float, reach: float) -> None:
        ways = []
        for direction in (-1.0, 1.0):
            state = PendulumState(foot.x, 0.0, direction * apex_speed, 0.0)
            x: list[float] = []
            v: list[float] = []
            while abs(state.x - foot.x) < reach and len(x) < 2000:
                x.append(state.x)
                v.append(abs(state.vx))
                state = pendulum.advance(state, foot, 0.002, 0.002)
            ways.append((x, v))
        (back_x, back_v), (x, v) = ways
        self._x, self._v = np.array(back_x[:0:-1] + x), np.array(back_v[:0:-1] + v)

    def boosted(self, after: float, speed: float, length: float) -> None:
        """Insert a sinusoidal segment at x = ``after``, and move what follows in position and speed (§7.1.6)."""
        if speed == 0.0:
            return
        at = float(np.interp(after, self._x, self._v))
        way = np.linspace(0.0, length, 21)
        before, behind = self._x < after, self._x > after
        self._x, self._v = (
            np.concatenate([self._x[before], after + way, self._x[behind] + length]),
            np.concatenate([
                self._v[before], at + 0.5 * speed * (1.0 - np.cos(np.pi * way / length)), self._v[behind] + speed
            ]),
        )  # fmt: skip

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return np.interp(x, self._x, self._v)


def _along(robot: Robot, config: OpenLoopConfig, blocks: Sequence[Block]) -> tuple[np.ndarray, np.ndarray, list[Swing]]:
    """The centre of mass's x over time, and when which foot swings."""
    feet = footholds(config, blocks)
    pendulum = Pendulum(_surface(config, blocks), robot.gravity, robot.mass / (robot.mass + config.slider_mass))
    paths = [_PhasePath(pendulum, Foot(x, 0.0, z), config.apex_speed, config.step_length) for x, z in feet[1:-1]]
    first = feet[1][0] - config.lift_off
    paths[0].boosted(first, config.boost_speed, config.boost_length)
    changes = [first]
    for n, (before, after) in enumerate(pairwise(paths), start=1):
        x = np.arange(feet[n][0], feet[n + 1][0], _X_STEP)
        faster = before(x) >= after(x)
        if faster[0] or not faster[-1]:
            raise ValueError(f"the paths of steps {n} and {n + 1} do not meet between their feet: change apex_speed")
        changes.append(float(x[np.argmax(faster)]))
    changes.append(feet[-2][0] + config.last_landing)

    times, xs, at = [], [], []  # at: when the stance foot changes
    rest = -config.wind_up
    start_v = float(paths[0](np.array([first]))[0])
    ahead = float(paths[0](np.array([first + _X_STEP]))[0])
    now = 0.0
    for x0, state1, duration in (
        (0.0, (rest, 0.0, 0.0), config.wind_up_time),
        (rest, (first, start_v, start_v * (ahead - start_v) / _X_STEP), config.push_time),
    ):
        t = np.arange(0.0, duration, _GRID)
        times.append(now + t)
        xs.append(_quintic(t, duration, (x0, 0.0, 0.0), state1))
        now += duration
    for path, begin, end in zip(paths, changes, changes[1:], strict=False):
        at.append(now)
        x = np.linspace(begin, end, max(2, round((end - begin) / _X_STEP)))
        speed = path(x)
        t = np.concatenate([[0.0], np.cumsum(np.diff(x) * 2.0 / (speed[1:] + speed[:-1]))])
        times.append(now + t[:-1])
        xs.append(x[:-1])
        now += float(t[-1])
    at.append(now)
    end, last = changes[-1], paths[-1]
    v, behind = (float(last(np.array([x]))[0]) for x in (end, end - _X_STEP))
    t = np.arange(0.0, config.stop_time + _GRID, _GRID)
    times.append(now + t)
    goal = 0.5 * (feet[-1][0] + feet[-2][0])
    leaving = (end, v, v * (v - behind) / _X_STEP)
    xs.append(_quintic(np.minimum(t, config.stop_time), config.stop_time, leaving, (goal, 0.0, 0.0)))

    swings, half = [], 0.5 * config.dual_time
    for n in range(config.steps):
        lift = at[n] + (half if n else 0.0)
        land = at[n + 1] - (half if n + 1 < config.steps else 0.0)
        swings.append(Swing(LEFT_FOOT if n % 2 == 0 else RIGHT_FOOT, lift, land, feet[n], feet[n + 2]))
    return np.concatenate(times), np.concatenate(xs), swings


def _distinct(times: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thinned to samples at least half a grid apart, which a spline goes through without wiggling."""
    keep, last = [], -math.inf
    for i, time in enumerate(times.tolist()):
        if time - last > 0.5 * _GRID:
            keep.append(i)
            last = time
    return times[keep], x[keep]


def _quintic(
    t: np.ndarray, duration: float, start: tuple[float, float, float], end: tuple[float, float, float]
) -> np.ndarray:
    """The quintic between two positions, speeds and accelerations."""
    d = duration
    rows = [
        [1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 0, 0],
        [1, d, d**2, d**3, d**4, d**5], [0, 1, 2 * d, 3 * d**2, 4 * d**3, 5 * d**4],
        [0, 0, 2, 6 * d, 12 * d**2, 20 * d**3],
    ]  # fmt: skip
    coefficients = np.linalg.solve(np.array(rows, float), np.array([*start, *end]))
    return np.polynomial.polynomial.polyval(t, coefficients)


def _smooth(s: float) -> float:
    """Quintic from 0 to 1 over s in [0, 1], constant outside."""
    s = min(max(s, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def _feet(
    config: OpenLoopConfig, blocks: Sequence[Block], swings: list[Swing], time: float
) -> list[tuple[float, float]]:
    """Where the feet are planned to be: up, over, down."""
    feet = [(0.5 * config.step_length, 0.0), (-0.5 * config.step_length, 0.0)]
    for swing in swings:
        if time >= swing.landing:
            feet[swing.foot] = swing.end
        elif time > swing.lift_off:
            s = (time - swing.lift_off) / (swing.landing - swing.lift_off)
            (x0, z0), (x1, z1) = swing.start, swing.end
            top = max(ground_height(blocks, x) for x in _between(x0, x1)) + config.clearance
            z = z0 + (top - z0) * _smooth(s / 0.5) if s < 0.5 else top + (z1 - top) * _smooth((s - 0.5) / 0.5)
            feet[swing.foot] = x0 + (x1 - x0) * _smooth((s - 0.08) / 0.84), z
    return feet


def _between(start: float, end: float) -> list[float]:
    """Places on a swing foot's way, both ends among them."""
    return [start + 0.05 * n * (end - start) for n in range(21)]


def _shares(swings: list[Swing], time: float, pressure: float, feet: list[tuple[float, float]]) -> list[float]:
    """Share of the load on each foot."""
    for swing in swings:
        if swing.lift_off < time < swing.landing:
            return [1.0, 0.0] if swing.foot == LEFT_FOOT else [0.0, 1.0]
    right, left = feet[RIGHT_FOOT][0], feet[LEFT_FOOT][0]
    share = min(max((pressure - left) / (right - left), 0.0), 1.0)
    return [share, 1.0 - share]


def _sampled(ticks: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(ticks, times, column) for column in values.T])
