"""Sensor models: what the DSPs' pins and the IMU's wire carry, made from the physical truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from plant.config import SensorConfig
from robots import imu, pins
from robots.description import Robot

AMBIENT = 25.0  # °C of the windings
SUPPLY = 48.0  # V
FOOT_SWITCH_FORCE = 5.0  # N that close a foot's switch


class JointSensors:
    """Encoders, current and supply of all drives, as integers on their pins."""

    def __init__(self, robot: Robot, config: SensorConfig, streams: Callable[[str], Any]) -> None:
        n, sensors = len(robot.joints), [joint.sensor for joint in robot.joints]
        bias = streams("plant.joints.bias").normal(2 * n)
        torque_bias = config.bias * bias[:n] * [sensor.torque_bias for sensor in sensors]
        self._spring_bias = torque_bias / [sensor.torque_resolution for sensor in sensors]  # counts
        self._current_bias = config.bias * bias[n:] * [sensor.current_bias for sensor in sensors]
        self._current_noise = config.noise * np.array([sensor.current_noise for sensor in sensors])
        self._noise = streams("plant.joints.noise")
        self._encoder = np.array([joint.sensor.encoder for joint in robot.joints])
        self._spring = np.array([joint.spring_counts_per_rad for joint in robot.joints])
        self._constant = np.zeros(len(robot.joints), np.int32)
        self._knees = [robot.joint_names.index(foot.joint) for foot in robot.feet]

    def write(
        self, inputs: np.ndarray, theta: np.ndarray, q: np.ndarray, current: np.ndarray, loads: np.ndarray
    ) -> None:
        """Fill ``inputs`` (n, N_INPUTS) int32 from rotor and joint angles, currents, foot loads [SI]."""
        inputs[:, pins.MOTOR_ENCODER] = np.rint(self._encoder * theta)
        inputs[:, pins.SPRING_ENCODER] = np.rint(self._spring * (theta - q) + self._spring_bias)
        sensed = current + self._current_bias + self._current_noise * self._noise.normal(len(theta))
        inputs[:, pins.CURRENT_ADC] = np.rint(sensed / pins.AMPERE_PER_COUNT)
        inputs[:, pins.TEMPERATURE_ADC] = round(AMBIENT / pins.KELVIN_PER_COUNT)
        inputs[:, pins.SUPPLY_ADC] = round(SUPPLY / pins.VOLT_PER_COUNT)
        for knee, load in zip(self._knees, loads, strict=True):
            inputs[knee, pins.SWITCHES] = pins.FOOT_SWITCH if load > FOOT_SWITCH_FORCE else 0

    def snapshot(self) -> Any:
        return self._noise.snapshot()

    def restore(self, state: Any) -> None:
        self._noise.restore(state)


class ImuSensor:
    """Gyroscope and accelerometer with white noise and a bias that is constant over a run."""

    def __init__(
        self, robot: Robot, config: SensorConfig, rate: float, streams: Callable[[str], Any]
    ) -> None:
        self._imu = robot.imu
        # a continuous-time density becomes a discrete deviation: divide the variance by the sample period
        self._gyro_deviation = config.noise * robot.imu.gyro_noise_density * rate**0.5
        self._force_deviation = config.noise * robot.imu.accelerometer_noise_density * rate**0.5
        bias = streams("plant.imu.bias").normal(6)
        self._gyro_bias = config.bias * robot.imu.gyro_bias * bias[:3]
        self._force_bias = config.bias * robot.imu.accelerometer_bias * bias[3:]
        self._noise = streams("plant.imu.noise")

    def sample(self, gyro: np.ndarray, force: np.ndarray) -> bytes:
        """The wire's bytes for the true angular velocity [rad/s] and specific force [m/s²]."""
        noise = self._noise.normal(6)
        return imu.encode(
            gyro + self._gyro_bias + self._gyro_deviation * noise[:3],
            force + self._force_bias + self._force_deviation * noise[3:],
            self._imu,
        )

    def snapshot(self) -> Any:
        return self._noise.snapshot()

    def restore(self, state: Any) -> None:
        self._noise.restore(state)
