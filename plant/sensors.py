"""Sensor models: what the DSPs' pins and the IMU's wire carry, made from the physical truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from plant.config import SensorConfig
from robots import imu, pins
from robots.description import Robot

AMBIENT = 25.0  # °C of the windings
SUPPLY = 48.0  # V
FOOT_SWITCH_FORCE = 5.0  # N that close a foot's switch


def sense(n: int) -> ca.Function:
    """Counts of ``n`` drives: ``(rotor[2n], q[n], current[n], noise[n], p[n, 5]) -> counts[3, n]``.

    counts: motor encoder, spring encoder, current ADC. p: scales of both encoders, error of the spring's zero [counts],
    error of the current's zero and its noise [A].
    """
    rotor, q, current = ca.SX.sym("rotor", 2 * n), ca.SX.sym("q", n), ca.SX.sym("current", n)
    noise, p = ca.SX.sym("noise", n), ca.SX.sym("p", n, 5)
    encoder, spring, spring_bias, current_bias, deviation = ca.horzsplit(p)
    theta = rotor[:n]
    counts = ca.horzcat(
        encoder * theta,
        spring * (theta - q) + spring_bias,
        (current + current_bias + deviation * noise) / pins.AMPERE_PER_COUNT,
    )
    rounded = ca.floor(counts + 0.5)
    return ca.Function("joint_sensors", [rotor, q, current, noise, p], [rounded.T])


class JointSensors:
    """Encoders, current and supply of all drives, as integers on their pins.

    ``rotor`` (angles, velocities), ``q`` [rad] and ``current`` [A] are read where they lie.
    """

    def __init__(
        self,
        robot: Robot,
        config: SensorConfig,
        streams: Callable[[str], Any],
        compile: Callable[[ca.Function], ca.Function],
        rotor: np.ndarray,
        q: np.ndarray,
        current: np.ndarray,
    ) -> None:
        n, sensors = len(robot.joints), [joint.sensor for joint in robot.joints]
        bias = streams("plant.joints.bias").normal(2 * n)
        torque_bias = config.bias * bias[:n] * [sensor.torque_bias for sensor in sensors]
        current_bias = config.bias * bias[n:] * [sensor.current_bias for sensor in sensors]
        self._p = np.concatenate([
            [sensor.encoder for sensor in sensors],
            [joint.spring_counts_per_rad for joint in robot.joints],
            torque_bias / [sensor.torque_resolution for sensor in sensors],
            current_bias,
            config.noise * np.array([sensor.current_noise for sensor in sensors]),
        ])  # fmt: skip
        self._noise, self._draw, self._counts = streams("plant.joints.noise"), np.zeros(n), np.zeros((n, 3))
        self._buffer, self._evaluate = compile(sense(n)).buffer()
        for index, array in enumerate((rotor, q, current, self._draw, self._p)):
            self._buffer.set_arg(index, memoryview(array))  # type: ignore[call-arg, arg-type]
        self._buffer.set_res(0, memoryview(self._counts.reshape(-1)))  # type: ignore[call-arg, arg-type]
        self._knees = [robot.joint_names.index(foot.joint) for foot in robot.feet]

    def connect(self, inputs: np.ndarray) -> None:
        """Put what never changes on the pins ``inputs`` (n, N_INPUTS) int32."""
        inputs[:, pins.TEMPERATURE_ADC] = round(AMBIENT / pins.KELVIN_PER_COUNT)
        inputs[:, pins.SUPPLY_ADC] = round(SUPPLY / pins.VOLT_PER_COUNT)

    def write(self, inputs: np.ndarray, loads: Sequence[float]) -> None:
        """Fill the pins from the present state and the feet's loads [N]."""
        self._draw[:] = self._noise.normal(len(self._draw))
        self._evaluate()
        inputs[:, : pins.CURRENT_ADC + 1] = self._counts  # the first three pins are those of ``sense``, in its order
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
