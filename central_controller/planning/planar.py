"""A biped in its sagittal plane, abduction at zero: inverse kinematics of its legs, its centre of mass.

Angles are the joints' own (about +y). A link that hangs down points to (x, z) = (sin α, −cos α) with α = −(its angle):
turning about +y swings what hangs down backwards. Kim 2018 (7.1)–(7.4) solve the same triangle for angles counted
otherwise, with the centre of mass at the hip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

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
        """Hip and knee angle [rad], knee in front, that put ``foot`` at (x, z) [m] from its hip, in the torso's axes.

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

    def _links(self, angles: Sequence[float]) -> list[tuple[float, float, float, float, float]]:
        """Mass [kg], moment of inertia about y [kg m²], x and z of the centre of mass [m] and angle [rad] of each link,
        in the torso's frame; abductions are taken as zero."""
        robot = self._robot
        frames: dict[str, tuple[float, float, float]] = {robot.base.name: (0.0, 0.0, 0.0)}  # x, z, angle
        links = [(robot.base.mass, robot.base.inertia[1], robot.base.com[0], robot.base.com[2], 0.0)]
        for joint, angle in zip(robot.joints, angles, strict=True):
            px, pz, turned = frames[joint.parent]
            c, s = math.cos(turned), math.sin(turned)
            along, up = joint.position[0], joint.position[2]
            x, z = px + c * along + s * up, pz - s * along + c * up
            turned += angle if joint.axis[1] else 0.0
            frames[joint.name] = x, z, turned
            c, s = math.cos(turned), math.sin(turned)
            com = joint.link.com
            links.append((
                joint.link.mass, joint.link.inertia[1],
                x + c * com[0] + s * com[2], z - s * com[0] + c * com[2], turned,
            ))  # fmt: skip
        return links

    def centre_of_mass(self, angles: Sequence[float]) -> Point:
        """Of the whole robot in the torso's frame [m], from joint angles of which the abductions are taken as zero."""
        links = self._links(angles)
        mass = sum(link[0] for link in links)
        return sum(link[0] * link[2] for link in links) / mass, sum(link[0] * link[3] for link in links) / mass

    def spin(self, positions: np.ndarray, step: float) -> np.ndarray:
        """Angular momentum about the centre of mass, about +y [kg m²/s], (n,), of a torso that does not turn.

        From joint angles [rad], (n, joints), every ``step`` [s], by differences.
        """
        mass, inertia, place, turned = self._motion(positions)
        place = place - (mass[:, None] * place).sum(axis=1, keepdims=True) / mass.sum()
        momentum = mass[:, None] * np.gradient(place, step, axis=0)
        return (_moment(place, momentum) + inertia * np.gradient(turned, step, axis=0)).sum(axis=1)

    def _motion(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of each link: mass and moment of inertia, (links,); place (n, links, 2) and angle (n, links) in the torso's
        frame."""
        links = np.array([self._links(angles) for angles in positions.tolist()])
        return links[0, :, 0], links[0, :, 1], links[:, :, 2:4], links[:, :, 4]

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
        self, torso: np.ndarray, positions: np.ndarray, feet: np.ndarray, forces: np.ndarray, step: float
    ) -> np.ndarray:
        """Joint torques [N m], (n, joints), of a motion whose torso does not turn: inverse dynamics, abductions zero.

        Args:
            torso: its origin; x, z [m], (n, 2).
            positions: joint angles [rad], (n, joints).
            feet: x, z [m], (n, 2, 2).
            forces: of the ground on the feet; x, z [N], (n, 2, 2).
            step: between the samples [s]; accelerations are differences.
        """
        mass, inertia, place, turned = self._motion(positions)
        place = place + torso[:, None]
        needed = mass[:, None] * (_second(place, step) + np.array([0.0, self._robot.gravity]))  # on each link, N
        turning = inertia * _second(turned, step)
        result = np.zeros_like(positions)
        for leg, foot, force in zip(self._legs, feet.swapaxes(0, 1), forces.swapaxes(0, 1), strict=True):
            hip, knee = leg.indices  # the links behind the joints are one further: the torso is the first
            axis = torso + leg.hip
            thigh = leg.forward - positions[:, hip]
            bent = axis + leg.thigh * np.column_stack([np.sin(thigh), -np.cos(thigh)])
            for joint, about, moved in ((hip, axis, (hip + 1, knee + 1)), (knee, bent, (knee + 1,))):
                result[:, joint] = -_moment(foot - about, force)
                for link in moved:
                    result[:, joint] += _moment(place[:, link] - about, needed[:, link]) + turning[:, link]
        return result


def _moment(arm: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """``arm`` × ``vector`` about +y; the last axis is x, z."""
    return arm[..., 1] * vector[..., 0] - arm[..., 0] * vector[..., 1]


def _second(values: np.ndarray, step: float) -> np.ndarray:
    """Second derivative along the first axis; zero at both ends."""
    result = np.zeros_like(values)
    result[1:-1] = np.diff(values, 2, axis=0) / step**2
    return result
