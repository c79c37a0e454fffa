"""Sensor models: what the DSPs' pins and the IMU's wire carry, made from the physical truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from plant.actuators.bank import ActuatorBank
from plant.actuators.model import Sensed
from plant.config import SensorConfig
from robots import imu, pins
from robots.description import Imu, Joint, Robot

FOOT_SWITCH_FORCE = 5.0  # N that close a foot's switch
_FILLED = pins.FORCE_ADC + 1  # pins that are filled from the actuators
# per joint: scales [counts per unit] of motor encoder, spring encoder, current, joint encoder and load cell, their
# zeros [counts], and the noise [counts, 1σ] of the last three
_PARAMETERS = 13


def sense(bank: ActuatorBank) -> ca.Function:
    """Counts of all drives: ``(*arguments of the bank, noise[3n], p[n, 13]) -> counts[pins, n]``."""
    n = len(bank.names)
    noise, p = ca.SX.sym("noise", 3 * n), ca.SX.sym("p", n, _PARAMETERS)
    (
        encoder, spring, ampere, joint, force,
        encoder_zero, spring_zero, current_zero, joint_zero, force_zero,
        current_noise, joint_noise, force_noise,
    ) = ca.horzsplit(p)  # fmt: skip
    current_draw, force_draw, joint_draw = ca.vertsplit(noise, n)
    sensed = Sensed(*(ca.vertcat(*column) for column in zip(*bank.symbols.sensed, strict=True)))
    counts = ca.SX.zeros(n, _FILLED)
    counts[:, pins.MOTOR_ENCODER] = encoder * sensed.motor + encoder_zero
    counts[:, pins.SPRING_ENCODER] = spring * sensed.deflection + spring_zero
    counts[:, pins.CURRENT_ADC] = ampere * sensed.current + current_zero + current_noise * current_draw
    counts[:, pins.TEMPERATURE_ADC] = sensed.temperature / pins.KELVIN_PER_COUNT
    counts[:, pins.SUPPLY_ADC] = sensed.supply / pins.VOLT_PER_COUNT
    counts[:, pins.JOINT_ENCODER] = joint * bank.symbols.q + joint_zero + joint_noise * joint_draw
    counts[:, pins.FORCE_ADC] = force * sensed.effort + force_zero + force_noise * force_draw
    rounded = ca.floor(counts + 0.5)
    return ca.Function("joint_sensors", [*bank.symbols.arguments, noise, p], [rounded.T])


class JointSensors:
    """Encoders, current, temperature, supply and load cell of all drives of ``bank``, as integers on their pins.

    Power comes on when this is made: the motors' quadrature encoders count from zero there. The joints' absolute
    encoders read their mounting offset at 0 rad, and are so mounted that a full turn's jump is out of a joint's range.
    """

    def __init__(
        self,
        robot: Robot,
        config: SensorConfig,
        streams: Callable[[str], Any],
        compile: Callable[[ca.Function], ca.Function],
        bank: ActuatorBank,
    ) -> None:
        n, joints = len(robot.joints), robot.joints
        bias = streams("plant.joints.bias").normal(2 * n)
        force_bias = streams("plant.joints.force_bias").normal(n)
        motor = bank.observe().motor
        rows = []
        for k, joint in enumerate(joints):
            sensor, per_ampere = joint.sensor, 1.0 / joint.actuator.ampere_per_count
            per_effort = 1.0 / sensor.force_resolution if sensor.force_resolution else 0.0
            rows.append([
                sensor.encoder, joint.spring_counts_per_rad, per_ampere, sensor.joint_encoder, per_effort,
                -np.rint(sensor.encoder * motor[k]),
                config.bias * bias[k] * sensor.torque_bias / sensor.torque_resolution,
                config.bias * bias[n + k] * sensor.current_bias * per_ampere,
                sensor.joint_encoder * joint_encoder_offset(joint, config, streams),
                config.bias * force_bias[k] * sensor.force_bias * per_effort,
                config.noise * sensor.current_noise * per_ampere,
                config.noise * sensor.joint_noise * abs(sensor.joint_encoder),
                config.noise * sensor.force_noise * per_effort,
            ])  # fmt: skip
        p = np.asfortranarray(rows).ravel(order="F")
        self._noise, self._draw = streams("plant.joints.noise"), np.zeros(3 * n)
        self._force_noise = streams("plant.joints.force_noise")
        self._with_force = any(joint.sensor.force_noise for joint in joints)
        self._joint_noise = streams("plant.joints.encoder_noise")
        self._with_joint = any(joint.sensor.joint_noise for joint in joints)
        self._counts = np.zeros((n, _FILLED))
        self._evaluate = bank.bind(compile(sense(bank)), self._counts.reshape(-1), more=(self._draw, p))
        self._n = n
        self._knees = [robot.joint_names.index(foot.joint) for foot in robot.feet]

    def write(self, inputs: np.ndarray, loads: Sequence[float]) -> None:
        """Fill the pins ``inputs`` (n, N_INPUTS) int32 from the present state and the feet's loads [N]."""
        n = self._n
        self._draw[:n] = self._noise.normal(n)
        if self._with_force:
            self._draw[n : 2 * n] = self._force_noise.normal(n)
        if self._with_joint:
            self._draw[2 * n :] = self._joint_noise.normal(n)
        self._evaluate()
        inputs[:, :_FILLED] = self._counts
        for knee, load in zip(self._knees, loads, strict=True):
            inputs[knee, pins.SWITCHES] = pins.FOOT_SWITCH if load > FOOT_SWITCH_FORCE else 0

    def snapshot(self) -> Any:
        return [stream.snapshot() for stream in (self._noise, self._force_noise, self._joint_noise)]

    def restore(self, state: Any) -> None:
        for stream, own in zip((self._noise, self._force_noise, self._joint_noise), state, strict=True):
            stream.restore(own)


def joint_encoder_offset(joint: Joint, config: SensorConfig, streams: Callable[[str], Any]) -> float:
    """What the absolute encoder of ``joint`` reads at 0 rad, rad: the same for a joint alone as for it in its robot."""
    residual, mounting = streams(f"plant.joints.encoder.{joint.name}").normal(2)
    mounted = config.encoder_offset.get(joint.name, config.mounting * mounting)
    return float(mounted + config.bias * residual * joint.sensor.joint_bias)


class ImuSensor:
    """Gyroscope and accelerometer with white noise and a constant bias; that of the gyro may drift as well."""

    def __init__(self, description: Imu, config: SensorConfig, rate: float, streams: Callable[[str], Any]) -> None:
        self._resolution = imu.resolutions(description)
        # a continuous-time density becomes a discrete deviation: divide the variance by the sample period
        gyro_deviation = config.noise * description.gyro_noise_density * rate**0.5
        force_deviation = config.noise * description.accelerometer_noise_density * rate**0.5
        self._deviation = np.repeat([gyro_deviation, force_deviation], 3)
        biases = [config.bias * description.gyro_bias, config.bias * description.accelerometer_bias]
        self._bias = np.repeat(biases, 3) * streams("plant.imu.bias").normal(6)
        self._noise = streams("plant.imu.noise")
        self._drift_noise = streams("plant.imu.drift")
        self._drift = config.gyro_drift * self._drift_noise.normal(3) if config.gyro_drift else np.zeros(3)
        self._drift_kept = math.exp(-1.0 / (config.gyro_drift_time * rate))  # per sample
        self._drift_deviation = config.gyro_drift * math.sqrt(1.0 - self._drift_kept**2)

    def sample(self, motion: np.ndarray) -> bytes:
        """The wire's bytes for the true angular velocity [rad/s] and specific force [m/s²], (6,)."""
        noise = self._noise.normal(6)
        if self._drift_deviation:
            self._drift = self._drift_kept * self._drift + self._drift_deviation * self._drift_noise.normal(3)
            motion = motion.copy()
            motion[:3] += self._drift
        return imu.pack(motion + self._bias + self._deviation * noise, self._resolution)

    def snapshot(self) -> Any:
        return self._noise.snapshot(), self._drift_noise.snapshot(), self._drift.copy()

    def restore(self, state: Any) -> None:
        noise, drift_noise, drift = state
        self._noise.restore(noise)
        self._drift_noise.restore(drift_noise)
        self._drift = drift.copy()
