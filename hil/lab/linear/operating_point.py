"""A system without what is not smooth, settled at an operating point."""

from __future__ import annotations

from hil.lab.quantity import changed
from hil.scenario import Scenario
from robots.description import Robot

# What a linear model has no place for, and its value in the system that is linearised.
SMOOTH = {
    "world.friction_scale": 0.0,
    "sensors.noise": 0.0,
    "sensors.bias": 0.0,
    "firmware.heartbeat_period": "0 s",  # ten of them a second would shift the frames behind them
}
_FINER = 1000.0  # encoders, load cells, currents
_FINER_GYRO, _FINER_ACCELEROMETER = 10.0, 2.0  # as far as 16 bits go


def smooth(scenario: Scenario) -> Scenario:
    """``scenario`` without dry friction, noise and bias."""
    return changed(scenario, dict(SMOOTH))


def fine(robot: Robot) -> Robot:
    """``robot`` with sensors and current loops of much finer resolution; the scales of the messages stay."""
    joints = tuple(
        joint.model_copy(update={
            "sensor": joint.sensor.model_copy(update={
                "encoder": joint.sensor.encoder * _FINER,
                "joint_encoder": joint.sensor.joint_encoder * _FINER,
                "torque_resolution": joint.sensor.torque_resolution / _FINER,
                "force_resolution": joint.sensor.force_resolution / _FINER,
            }),
            "actuator": joint.actuator.model_copy(update={
                "ampere_per_count": joint.actuator.ampere_per_count / _FINER,
            }),
        })
        for joint in robot.joints
    )  # fmt: skip
    imu = robot.imu
    if imu is not None:
        imu = imu.model_copy(update={
            "gyro_resolution": imu.gyro_resolution / _FINER_GYRO,
            "accelerometer_resolution": imu.accelerometer_resolution / _FINER_ACCELEROMETER,
        })  # fmt: skip
    return robot.model_copy(update={"joints": joints, "imu": imu})
