"""From counts to SI: positions and velocities of motor and joint, torque.

In equivalent rotary coordinates (``robots.actuators``) the compliant element sits between motor and output: the effort
is its stiffness times its deflection, the output is where the motor is less the deflection. A linkage maps the joint to
the output, phi = f(q) (Kim 2018 (5.22)); without one they are the same.
"""

from __future__ import annotations

import math
from typing import Protocol

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Block, Offsets, Symbols, clip
from joint_firmware.laws.signals import Sensed
from joint_firmware.laws.velocity import ESTIMATORS
from robots import pins
from robots.description import Joint
from robots.linkage import Linkage

_EDGE = 0.05  # rad before the linkage is folded or stretched out, where its map goes on as a straight line


class JointMap(Protocol):
    """Between a joint's angle q and its actuator's coordinate phi, in equivalent rotary coordinates."""

    def to_motor(self, q: ca.SX) -> ca.SX:
        """phi = f(q), rad."""

    def to_joint(self, phi: ca.SX) -> ca.SX:
        """q = f⁻¹(phi), rad."""

    def ratio(self, q: ca.SX) -> ca.SX | float:
        """f'(q): torque on the joint per effort, motor velocity per joint velocity."""


class Direct:
    """A rotary actuator on the joint's axis."""

    def to_motor(self, q: ca.SX) -> ca.SX:
        return q

    def to_joint(self, phi: ca.SX) -> ca.SX:
        return phi

    def ratio(self, q: ca.SX) -> float:
        return 1.0


class ThroughLinkage:
    """A slider-crank. A wrong encoder may say what no linkage can do: beyond its range, f is a straight line."""

    def __init__(self, linkage: Linkage) -> None:
        self._linkage = linkage
        self._low, self._high = _EDGE - linkage.offset, math.pi - _EDGE - linkage.offset
        ends = (float(linkage.motor_coordinate(q)) for q in (self._low, self._high))
        self._phi_low, self._phi_high = ends

    def to_motor(self, q: ca.SX) -> ca.SX:
        inside = clip(q, self._low, self._high)
        return self._linkage.motor_coordinate(inside) + self._linkage.ratio(inside) * (q - inside)

    def to_joint(self, phi: ca.SX) -> ca.SX:
        inside = clip(phi, self._phi_low, self._phi_high)
        q = self._linkage.joint_angle(inside)
        return q + (phi - inside) / self._linkage.ratio(q)

    def ratio(self, q: ca.SX) -> ca.SX:
        return self._linkage.ratio(clip(q, self._low, self._high))


class SensingBlock(Block):
    """Base of the ways to sense a joint; ``estimator`` is one of ``ESTIMATORS``."""

    def __init__(self, estimator: str, joint_map: JointMap) -> None:
        raise NotImplementedError

    def sense(self, counts: ca.SX, x: Symbols, p: Symbols) -> tuple[Sensed, Symbols]:
        """The signals, and the states of the next tick."""
        raise NotImplementedError


class Sensing(SensingBlock):
    """Encoders of the motor and of the spring between motor and output."""

    def __init__(self, estimator: str, joint_map: JointMap) -> None:
        self._map = joint_map
        self._motor = ESTIMATORS[estimator]("motor")
        self._deflection = ESTIMATORS[estimator]("deflection")
        self.states = ("started", *self._motor.states, *self._deflection.states)
        self.parameters = (
            "rad_per_count", "motor_offset", "rad_per_spring_count", "stiffness", "spring_offset",
            *self._motor.parameters,
        )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {
            "rad_per_count": 1.0 / joint.sensor.encoder,
            "motor_offset": offsets.motor,
            "rad_per_spring_count": 1.0 / joint.spring_counts_per_rad,
            "stiffness": joint.actuator.stiffness,
            "spring_offset": offsets.spring,
            **self._motor.settings(config),
        }

    def sense(self, counts: ca.SX, x: Symbols, p: Symbols) -> tuple[Sensed, Symbols]:
        phi = counts[pins.MOTOR_ENCODER] * p.rad_per_count - p.motor_offset
        resolution = ca.fabs(p.rad_per_count)
        motor_velocity, after = self._motor.estimate(phi, x.started, resolution, x, p)
        deflection = counts[pins.SPRING_ENCODER] * p.rad_per_spring_count - p.spring_offset
        resolution = ca.fabs(p.rad_per_spring_count)
        rate, more = self._deflection.estimate(deflection, x.started, resolution, x, p)
        effort = p.stiffness * deflection
        output, output_velocity = phi - deflection, motor_velocity - rate
        q = self._map.to_joint(output)
        ratio = self._map.ratio(q)
        sensed = Sensed(
            motor_position=phi, position=q, motor_velocity=motor_velocity, velocity=output_velocity / ratio,
            torque=ratio * effort, effort=effort, ratio=ratio, output_velocity=output_velocity,
        )  # fmt: skip
        return sensed, Symbols(started=1, **after, **more)
