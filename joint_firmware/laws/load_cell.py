"""Sensing of a hydraulic joint: a potentiometer at the joint and a load cell at the piston (Rotella 2018 §II.1).

Where the piston is, and how fast it moves, the joint tells through the linkage's map; no encoder is on the piston.
"""

from __future__ import annotations

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Offsets, Symbols
from joint_firmware.laws.sensing import JointMap, SensingBlock
from joint_firmware.laws.signals import Sensed
from joint_firmware.laws.velocity import ESTIMATORS
from robots import pins
from robots.actuators import Hydraulic
from robots.description import Joint


class LoadCellSensing(SensingBlock):
    def __init__(self, estimator: str, joint_map: JointMap) -> None:
        self._map = joint_map
        self._joint = ESTIMATORS[estimator]("joint")
        self.states = ("started", *self._joint.states)
        self.parameters = ("rad_per_joint_count", "joint_offset", "effort_per_count", *self._joint.parameters)

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {
            "rad_per_joint_count": 1.0 / joint.sensor.joint_encoder,
            "joint_offset": offsets.joint,
            "effort_per_count": joint.sensor.force_resolution,
            **self._joint.settings(config),
        }

    def sense(self, counts: ca.SX, x: Symbols, p: Symbols) -> tuple[Sensed, Symbols]:
        q = counts[pins.JOINT_ENCODER] * p.rad_per_joint_count - p.joint_offset
        velocity, after = self._joint.estimate(q, x.started, ca.fabs(p.rad_per_joint_count), x, p)
        effort = counts[pins.FORCE_ADC] * p.effort_per_count
        ratio = self._map.ratio(q)
        sensed = Sensed(
            motor_position=self._map.to_motor(q), position=q, motor_velocity=ratio * velocity, velocity=velocity,
            torque=ratio * effort, effort=effort, ratio=ratio, output_velocity=ratio * velocity,
        )  # fmt: skip
        return sensed, Symbols(started=1, **after)


def has_load_cell(joint: Joint) -> bool:
    """Whether a load cell gives the effort, and not a spring's deflection."""
    return isinstance(joint.actuator, Hydraulic)
