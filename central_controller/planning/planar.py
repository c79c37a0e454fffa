"""A biped in its sagittal plane, abduction at zero: inverse kinematics of its legs, its centre of mass.

Angles are the joints' own (about +y). A link that hangs down points to (x, z) = (sin α, −cos α) with α = −(its angle):
turning about +y swings what hangs down backwards. Kim 2018 (7.1)–(7.4) solve the same triangle for angles counted
otherwise, with the centre of mass at the hip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from robots.description import Joint, Robot

Point = tuple[float, float]  # x, z [m]


class _Leg(NamedTuple):
    hip: Point  # in the torso's frame
    thigh: float  # m, hip to knee
    shank: float  # m, knee to foot
    forward: float  # rad, of the knee from straight below the hip at zero hip angle
    indices: tuple[int, int]  # of hip and knee among the joints


class PlanarBiped:
    """Two legs of abduction, hip and knee each, as ``robots/hume.toml`` has them."""

    def __init__(self, robot: Robot) -> None:
        """Raises ValueError for a robot whose legs are other than that."""
        self._robot = robot
        self._legs = [self._leg(robot, foot.joint, foot.position) for foot in robot.feet]

    @staticmethod
    def _leg(robot: Robot, tip: str, foot: tuple[float, float, float]) -> _Leg:
        by_name = {joint.name: joint for joint in robot.joints}
        chain: list[Joint] = []
        while tip != robot.base.name:
            chain.insert(0, by_name[tip])
            tip = chain[0].parent
        axes = [joint.axis for joint in chain]
        if axes != [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)] or foot[0] != 0.0:
            raise ValueError(f"{robot.name}: planar kinematics need legs of abduction, hip and knee, the foot in line")
        abduction, hip, knee = chain
        names = robot.joint_names
        return _Leg(
            (abduction.position[0] + hip.position[0], abduction.position[2] + hip.position[2]),
            math.hypot(knee.position[0], knee.position[2]),
            -foot[2],
            math.atan2(knee.position[0], -knee.position[2]),
            (names.index(hip.name), names.index(knee.name)),
        )

    def hip(self, foot: int) -> Point:
        """Hip axis of the leg with ``foot`` (index among the robot's feet) in the torso's frame [m]."""
        return self._legs[foot].hip

    def leg_angles(self, foot: int, x: float, z: float) -> tuple[float, float]:
        """Hip and knee angle [rad], knee in front, that put ``foot`` at (x, z) [m] from its hip, along the torso's axes.

        Raises ValueError when it is out of reach.
        """
        leg = self._legs[foot]
        square = x * x + z * z
        cosine = (square - leg.thigh**2 - leg.shank**2) / (2.0 * leg.thigh * leg.shank)
        if not -1.0 < cosine < 1.0:
            raise ValueError(
                f"the {self._robot.feet[foot].name} would be {math.sqrt(square):.3f} m from its hip, "
                f"out of reach of {leg.thigh + leg.shank:.3f} m"
            )
        bend = math.acos(cosine)
        thigh = math.atan2(x, -z) + math.atan2(leg.shank * math.sin(bend), leg.thigh + leg.shank * math.cos(bend))
        return leg.forward - thigh, bend - leg.forward

    def joints(self, torso: Point, pitch: float, feet: Sequence[Point]) -> list[float]:
        """Joint angles [rad], robot's order, with the torso's origin at ``torso`` and the ``feet`` where given."""
        angles = [0.0] * len(self._robot.joints)
        c, s = math.cos(pitch), math.sin(pitch)
        for n, (leg, foot) in enumerate(zip(self._legs, feet, strict=True)):
            dx, dz = foot[0] - torso[0], foot[1] - torso[1]
            hip, knee = self.leg_angles(n, c * dx - s * dz - leg.hip[0], s * dx + c * dz - leg.hip[1])
            angles[leg.indices[0]], angles[leg.indices[1]] = hip, knee
        return angles

    def centre_of_mass(self, angles: Sequence[float]) -> Point:
        """Of the whole robot in the torso's frame [m], from joint angles of which the abductions are taken as zero."""
        robot = self._robot
        frames: dict[str, tuple[float, float, float]] = {robot.base.name: (0.0, 0.0, 0.0)}  # x, z, angle
        mass = robot.base.mass
        mx, mz = mass * robot.base.com[0], mass * robot.base.com[2]
        for joint, angle in zip(robot.joints, angles, strict=True):
            px, pz, turned = frames[joint.parent]
            c, s = math.cos(turned), math.sin(turned)
            x, z = (
                px + c * joint.position[0] + s * joint.position[2],
                pz - s * joint.position[0] + c * joint.position[2],
            )
            turned += angle if joint.axis[1] else 0.0
            frames[joint.name] = x, z, turned
            c, s = math.cos(turned), math.sin(turned)
            m, com = joint.link.mass, joint.link.com
            mass += m
            mx += m * (x + c * com[0] + s * com[2])
            mz += m * (z - s * com[0] + c * com[2])
        return mx / mass, mz / mass

    def posture(self, com: Point, feet: Sequence[Point], pitch: float = 0.0) -> tuple[list[float], Point]:
        """Joint angles [rad] and the torso's origin with the centre of mass at ``com`` and the feet at ``feet`` [m],
        world's axes.

        The torso is moved until the whole robot's centre of mass is there; legs are light, so few rounds do.
        """
        torso = (com[0], com[1] - self._robot.base.com[2])
        c, s = math.cos(pitch), math.sin(pitch)
        for _ in range(50):
            angles = self.joints(torso, pitch, feet)
            x, z = self.centre_of_mass(angles)
            error = com[0] - torso[0] - (c * x + s * z), com[1] - torso[1] - (-s * x + c * z)
            torso = (torso[0] + error[0], torso[1] + error[1])
            if abs(error[0]) + abs(error[1]) < 1e-10:
                break
        return angles, torso

    def torques(
        self, torso: Point, pitch: float, angles: Sequence[float], feet: Sequence[Point], forces: Sequence[Point]
    ) -> list[float]:
        """Joint torques [N m] that hold forces (x, z) [N] of the ground on the feet, of legs without weight."""
        result = [0.0] * len(angles)
        c, s = math.cos(pitch), math.sin(pitch)
        for leg, foot, (fx, fz) in zip(self._legs, feet, forces, strict=True):
            hip, knee = leg.indices
            x, z = torso[0] + c * leg.hip[0] + s * leg.hip[1], torso[1] - s * leg.hip[0] + c * leg.hip[1]
            result[hip] = fz * (foot[0] - x) - fx * (foot[1] - z)  # a turn about +y moves what is below backwards
            thigh = leg.forward - pitch - angles[hip]
            x, z = x + leg.thigh * math.sin(thigh), z - leg.thigh * math.cos(thigh)
            result[knee] = fz * (foot[0] - x) - fx * (foot[1] - z)
        return result
