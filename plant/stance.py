"""Initial posture: torso upright, feet where the stance wants them, centre of mass above their middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.config import StanceConfig
from robots.description import Foot, Joint, Robot

Array = NDArray[np.float64]

_STEPS = 200  # of damped Newton; a stance in reach takes about ten
_TOLERANCE = 1e-11  # m


class StanceError(ValueError):
    """The feet cannot be put where the stance wants them."""


@dataclass(frozen=True)
class Stance:
    """Where the robot starts, in the world frame (origin: midpoint of the two foot centres, z up, x forward).

    ``torso``: (3,) position of the torso frame's origin [m], whose axes are parallel to the world's.
    ``joints``: (n,) joint angles [rad], robot's order. ``feet``: (2, 3) foot centres [m], right then left.
    """

    torso: Array
    joints: Array
    feet: Array


def rotation(axis: tuple[float, float, float], angle: float) -> Array:
    """Rotation matrix about ``axis`` (any length) by ``angle`` [rad] (Rodrigues)."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def chain(robot: Robot, foot: Foot) -> list[int]:
    """Indices of the joints between the base and ``foot``, from the base outwards."""
    order: list[int] = []
    name = foot.joint
    while name != robot.base.name:
        index = robot.joint_names.index(name)
        order.insert(0, index)
        name = robot.joints[index].parent
    return order


def _forward(joints: list[Joint], angles: Array, tip: tuple[float, float, float]) -> tuple[Array, Array]:
    """Foot centre (3,) in the torso frame, and its Jacobian (3, len(joints))."""
    frame, origin = np.eye(3), np.zeros(3)
    axes, origins = [], []
    for joint, angle in zip(joints, angles, strict=True):
        origin = origin + frame @ np.asarray(joint.position)
        axes.append(frame @ (np.asarray(joint.axis) / np.linalg.norm(joint.axis)))
        origins.append(origin)
        frame = frame @ rotation(joint.axis, float(angle))
    point = origin + frame @ np.asarray(tip)
    jacobian = np.column_stack([np.cross(a, point - o) for a, o in zip(axes, origins, strict=True)])
    return point, jacobian


def _leg(robot: Robot, foot: Foot, target: Array) -> Array:
    """Joint angles that put ``foot`` at ``target`` (3,) in the torso frame, the last one positive."""
    joints = [robot.joints[i] for i in chain(robot, foot)]
    angles = np.zeros(len(joints))
    angles[-1], angles[-2] = 1.2, -0.6  # bent this way, Newton's method finds the solution on this side
    damping = 1e-3
    point, jacobian = _forward(joints, angles, foot.position)
    for _ in range(_STEPS):
        error = target - point
        distance = float(np.linalg.norm(error))
        if distance < _TOLERANCE:
            break
        normal = jacobian.T @ jacobian + damping * np.eye(len(joints))
        trial = angles + np.clip(np.linalg.solve(normal, jacobian.T @ error), -0.4, 0.4)
        trial_point, trial_jacobian = _forward(joints, trial, foot.position)
        if np.linalg.norm(target - trial_point) < distance:
            angles, point, jacobian, damping = trial, trial_point, trial_jacobian, damping * 0.1
        else:
            damping *= 10.0
    else:
        raise StanceError(
            f"the {foot.name} is {float(np.linalg.norm(target - point)) * 1e3:.1f} mm short of its place; "
            "lower stance.hip_height or bring the feet closer (stance.feet_apart, stance.feet_width)"
        )
    for joint, angle in zip(joints, angles, strict=True):
        if not joint.limits[0] <= angle <= joint.limits[1]:
            raise StanceError(
                f"the stance needs {joint.name} at {np.degrees(angle):.1f}°, beyond its limits "
                f"{np.degrees(joint.limits[0]):.1f}° to {np.degrees(joint.limits[1]):.1f}°"
            )
    if angles[-1] < 0.0:
        raise StanceError(f"the stance would bend {joints[-1].name} backwards; change stance.hip_height")
    return angles


def centre_of_mass(robot: Robot, joints: Array) -> Array:
    """Centre of mass (3,) of the robot in the torso frame [m]."""
    frames = {robot.base.name: (np.eye(3), np.zeros(3))}
    moment = robot.base.mass * np.asarray(robot.base.com)
    for joint, angle in zip(robot.joints, joints, strict=True):
        parent, origin = frames[joint.parent]
        origin = origin + parent @ np.asarray(joint.position)
        frame = parent @ rotation(joint.axis, float(angle))
        frames[joint.name] = frame, origin
        moment = moment + joint.link.mass * (origin + frame @ np.asarray(joint.link.com))
    return moment / robot.mass


def hip_offset(robot: Robot) -> float:
    """Height of the hip axes (the mean of the legs' first joints) in the torso frame, m."""
    return float(np.mean([robot.joints[chain(robot, foot)[0]].position[2] for foot in robot.feet]))


def initial(robot: Robot, config: StanceConfig) -> Stance:
    """The configuration of ``config``, knees bent towards positive angles.

    ``robot`` has two feet, right then left. Fore and aft the torso is placed so that the centre of mass is
    above the origin: two point feet abreast carry no moment about the axis through them.

    Raises StanceError when a foot is out of reach or a joint would be beyond its limits.
    """
    if len(robot.feet) != 2:
        raise StanceError(f"a stance is for two feet; {robot.name} has {len(robot.feet)}")
    half = np.array([0.5 * config.feet_apart, -0.5 * config.feet_width, 0.0])
    feet = np.array([half, -half])
    torso = np.array([0.0, 0.0, config.hip_height - hip_offset(robot)])
    joints = np.zeros(len(robot.joints))
    for _ in range(100):
        for foot, centre in zip(robot.feet, feet, strict=True):
            joints[chain(robot, foot)] = _leg(robot, foot, centre - torso)
        shift = float(torso[0] + centre_of_mass(robot, joints)[0])
        if abs(shift) < 1e-12:
            break
        torso[0] -= shift
    # To 0.1 nm and 0.1 nrad: the last bits depend on which kernels numpy picks for the processor, and so would a run.
    return Stance(np.round(torso, 10), np.round(joints, 10), feet)
