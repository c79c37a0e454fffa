"""Steps planned beforehand as joint angles over time: Kim 2018 §7.1, without any feedback from above the joints.

The centre of mass follows, in phase space, the pendulum of each stance foot with its given speed above the foot; two
feet's paths meet where both have the same speed, and there the stance foot changes. The pendulum drags the planarizer's
slider along, (7.5), on a height that rises above each foot and sinks where the next one lands, (7.6), (7.7). On both
feet before the first and after the last step a polynomial brings it up to speed and to rest. With the feet's ways, the
legs' inverse kinematics give the joint angles.

Two things are not in the source. The way deviates by some millimetres to allow for the swing leg's angular momentum
(``swing_momentum``), and the weight goes over from foot to foot evenly. And there are torques, by inverse dynamics:
in a joint-position loop of stiffness K a torque is a position moved by torque / K, against the sagging that the source
has moved its centre of mass for by hand (§7.1.3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from central_controller.planning import support, swing_momentum
from central_controller.planning.config import OpenLoopConfig
from central_controller.planning.height_surface import CosineProfile
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.planar import PlanarBiped
from robots.description import Robot
from robots.terrain import Block, ground_height

RIGHT_FOOT, LEFT_FOOT = 0, 1  # indices among the robot's feet
_GRID = 0.004  # s, of the inverse kinematics
_X_STEP = 5e-4  # m, in phase space
_SHORTEST_SWING = 0.1  # s
_ROUNDS = 2  # the legs' momentum and the way that allows for it find to each other within 0.1 mm


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
    torques: np.ndarray  # (n, joints) N m
    com: np.ndarray  # (n, 2) x, z [m]
    com_velocity: np.ndarray  # (n, 2)
    pressure: np.ndarray  # (n,) x of the centre of pressure that the plan needs [m]
    feet: np.ndarray  # (n, 2, 2) right, left; x, z [m]
    swings: list[Swing]


def plan(robot: Robot, config: OpenLoopConfig, rate: float, blocks: Sequence[Block] = ()) -> Motion:
    """Plan the whole motion over ``blocks``, sampled at ``rate`` [Hz].

    Raises ValueError, in one sentence, when the robot cannot do it: a foothold on the edge of a block, a swing foot
    that would go through one or is out of reach of its hip; no time to swing; a centre of mass that would fall faster
    than freely; on both feet, a centre of pressure that is not between them.
    """
    for n, (x, z) in enumerate(footholds(config, blocks)):
        if n < 2 and z:
            raise ValueError(f"a block lies where a foot stands at the start, at {x:g} m: move the block")
        if any(ground_height(blocks, x + side * robot.foot_radius) != z for side in (-1.0, 1.0)):
            raise ValueError(
                f"the foothold at {x:g} m is on the edge of a block: change step_length, or move the block"
            )
    way, swings = _along(robot, config, blocks)
    height = _surface(config, blocks)
    times = np.arange(0.0, way.end + 0.5, _GRID)
    com_x, speed, acceleration = way(times)
    heights = np.array([height(value, 0.0) for value in com_x.tolist()])
    com_z, dz = heights[:, 0], heights[:, 1] * speed
    ddz = heights[:, 3] * speed**2 + heights[:, 1] * acceleration
    vertical = robot.mass * (robot.gravity + ddz)
    moved = robot.mass + config.slider_mass  # along x, (7.5)
    feet = np.array([_feet(config, blocks, swings, time) for time in times.tolist()])
    _check_clearance(blocks, times, feet, swings)
    stance = support.stance(times, [(swing.lift_off, swing.landing, 1 - swing.foot) for swing in swings])
    biped = PlanarBiped(robot)
    com = np.column_stack([com_x, com_z])
    positions, torso = _postures(biped, com, feet)
    support.check_pressed(times, vertical)

    spin = np.zeros(len(times))
    force = np.column_stack([moved * acceleration, vertical])
    _, pressure = support.supported(com, force, spin, feet, stance)
    wanted = _passed_on(times, pressure, swings)
    above = com_z - np.where(stance == LEFT_FOOT, feet[:, LEFT_FOOT, 1], feet[:, RIGHT_FOOT, 1])
    square = vertical / (moved * above)
    for _ in range(_ROUNDS):
        if config.swing_momentum:
            spin = np.gradient(biped.spin(positions, _GRID), _GRID)
        push = square * (pressure - wanted) - spin / (moved * above)
        change = swing_momentum.deviation(_GRID, square, push, stance != support.BOTH)
        com[:, 0] = com_x + change
        positions, torso = _postures(biped, com, feet)
    speed, acceleration = speed + np.gradient(change, _GRID), acceleration + _curvature(change)
    force = np.column_stack([moved * acceleration, vertical])
    shares, pressure = support.supported(com, force, spin, feet, stance)
    support.check_between(times, pressure, feet, stance)

    forces = np.stack([shares, 1.0 - shares], axis=1)[:, :, None] * force[:, None]
    torques = biped.torques(torso, positions, feet, forces, _GRID)
    if config.drive_damping:
        torques += config.drive_damping * _motor_speeds(robot, positions, torques)
    ticks = np.arange(0.0, times[-1], 1.0 / rate)
    joints = CubicSpline(times, positions)
    return Motion(
        ticks, joints(ticks), joints(ticks, 1), _sampled(ticks, times, torques),
        _sampled(ticks, times, com), _sampled(ticks, times, np.column_stack([speed, dz])),
        np.interp(ticks, times, pressure), _sampled(ticks, times, feet.reshape(-1, 4)).reshape(-1, 2, 2), swings,
    )  # fmt: skip


def _postures(biped: PlanarBiped, com: np.ndarray, feet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles [rad], (n, joints), and the torso's origin [m], (n, 2), sample by sample. Raises ValueError."""
    positions, torso = zip(*map(biped.posture, com.tolist(), feet.tolist()), strict=True)
    return np.array(positions), np.array(torso)


def _motor_speeds(robot: Robot, positions: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """Of the motors behind the springs, in the joints' coordinates [rad/s], (n, joints)."""
    stiffness = np.array([joint.actuator.stiffness for joint in robot.joints])
    return np.gradient(positions + torques / stiffness, _GRID, axis=0)


def _passed_on(times: np.ndarray, pressure: np.ndarray, swings: list[Swing]) -> np.ndarray:
    """The centre of pressure [m], (n,), going over evenly while both feet stand between two steps.

    Where two paths meet in phase space it jumps, which no drive follows: the weight would come late.
    """
    result = pressure.copy()
    for before, after in pairwise(swings):
        both = (times >= before.landing) & (times <= after.lift_off)
        share = (times[both] - before.landing) / max(after.lift_off - before.landing, _GRID)
        result[both] = (1.0 - share) * after.start[0] + share * before.end[0]
    return result


def _curvature(values: np.ndarray) -> np.ndarray:
    """Second derivative on the grid; zero at both ends."""
    return np.pad(np.diff(values, 2), 1) / _GRID**2


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
            while abs(state.x - foot.x) < reach:
                if len(x) == 2000:
                    raise ValueError(f"the centre of mass hardly leaves the foot at {foot.x:g} m: raise apex_speed")
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


def _along(robot: Robot, config: OpenLoopConfig, blocks: Sequence[Block]) -> tuple[_Way, list[Swing]]:
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
    start_speed = float(paths[0](np.array([first]))[0])

    def acceleration(x: float, speed: float, n: int) -> float:
        """On the n-th stance foot [m/s²]."""
        return pendulum.acceleration(PendulumState(x, 0.0, speed, 0.0), Foot(feet[n][0], 0.0, feet[n][1]))[0]

    way, rest = _Way(), (-config.wind_up, 0.0, 0.0)
    leaving = (first, start_speed, acceleration(first - 1e-9, start_speed, 1))
    way.append(*_quintic(config.wind_up_time, (0.0, 0.0, 0.0), rest))
    way.append(*_quintic(config.push_time, rest, leaving))
    at = [way.end]  # when the stance foot changes
    for path, begin, end in zip(paths, changes, changes[1:], strict=False):
        x = np.linspace(begin, end, max(3, round((end - begin) / _X_STEP)))
        speed = path(x)
        t = np.concatenate([[0.0], np.cumsum(np.diff(x) * 2.0 / (speed[1:] + speed[:-1]))])
        way.append(t, x, float(speed[0]), float(speed[-1]))
        at.append(way.end)
    end = changes[-1]
    end_speed = float(paths[-1](np.array([end]))[0])
    arriving = (end, end_speed, acceleration(end + 1e-9, end_speed, -2))
    way.append(*_quintic(config.stop_time, arriving, (0.5 * (feet[-1][0] + feet[-2][0]), 0.0, 0.0)))

    swings, half = [], 0.5 * config.dual_time
    for n in range(config.steps):
        lift = at[n] + (half if n else 0.0)
        land = at[n + 1] - (half if n + 1 < config.steps else 0.0)
        if land - lift < _SHORTEST_SWING:
            raise ValueError(f"step {n + 1} leaves {land - lift:.2f} s to swing a foot: lower apex_speed or dual_time")
        swings.append(Swing(LEFT_FOOT if n % 2 == 0 else RIGHT_FOOT, lift, land, feet[n], feet[n + 2]))
    return way, swings


class _Way:
    """x over time in pieces that meet in place and speed; the acceleration jumps where the stance foot changes."""

    def __init__(self) -> None:
        self._pieces: list[CubicSpline] = []
        self._starts: list[float] = []
        self.end = 0.0  # s

    def append(self, times: np.ndarray, x: np.ndarray, start_speed: float, end_speed: float) -> None:
        """A piece through ``x`` [m] at ``times`` [s], counted from its start, between two speeds [m/s]."""
        self._pieces.append(CubicSpline(times, x, bc_type=((1, start_speed), (1, end_speed))))
        self._starts.append(self.end)
        self.end += float(times[-1])

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x [m], speed [m/s], acceleration [m/s²] at ``times`` [s]; at rest behind the end."""
        inside = np.minimum(times, self.end)
        which = np.searchsorted(self._starts, inside, side="right") - 1
        result = np.zeros((3, len(times)))
        for n, (piece, start) in enumerate(zip(self._pieces, self._starts, strict=True)):
            here = which == n
            result[:, here] = [piece(inside[here] - start, order) for order in range(3)]
        result[1:, times > self.end] = 0.0
        return result[0], result[1], result[2]


def _quintic(
    duration: float, start: tuple[float, float, float], end: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """The quintic between two positions, speeds and accelerations: times, values, both speeds."""
    d = duration
    rows = [
        [1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 0, 0],
        [1, d, d**2, d**3, d**4, d**5], [0, 1, 2 * d, 3 * d**2, 4 * d**3, 5 * d**4],
        [0, 0, 2, 6 * d, 12 * d**2, 20 * d**3],
    ]  # fmt: skip
    coefficients = np.linalg.solve(np.array(rows, float), np.array([*start, *end]))
    times = np.linspace(0.0, d, max(3, math.ceil(d / _GRID) + 1))
    return times, np.polynomial.polynomial.polyval(times, coefficients), start[1], end[1]


def _check_clearance(blocks: Sequence[Block], times: np.ndarray, feet: np.ndarray, swings: list[Swing]) -> None:
    """Raise ValueError where a swing foot would be inside a block."""
    for swing in swings:
        inside = (times > swing.lift_off) & (times < swing.landing)
        for x, z in feet[inside, swing.foot].tolist():
            if z < ground_height(blocks, x) - 1e-9:
                raise ValueError(
                    f"the swing foot would go through the block at {x:.2f} m: raise clearance, or move the block"
                )


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


def _sampled(ticks: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(ticks, times, column) for column in values.T])
