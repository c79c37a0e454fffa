"""Faults of the joints' sensors, on the pins behind the sensor models, and the keys of what is wrong with a joint.

Nothing here is called while all sensors are well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robots import pins
from robots.description import Joint, Robot

JUMP, NOISE = 0.1, 0.005  # rad: of a jump, and the deviation of the noise of an encoder
CURRENT_JUMP, CURRENT_NOISE = 1.5, 0.5  # the same of a current sensor, of its drive's current limit
SLIP = 0.1  # share of its counts that a slipping encoder loses

_SENSORS = {
    "encoder": pins.MOTOR_ENCODER,
    "spring_encoder": pins.SPRING_ENCODER,
    "joint_encoder": pins.JOINT_ENCODER,
    "current_sensor": pins.CURRENT_ADC,
}


@dataclass
class _Fault:
    """What is wrong with one pin. ``held``: its reading when the fault began, None until then."""

    joint: int
    pin: int
    kind: str
    jump: float  # counts
    deviation: float  # counts
    held: int | None = None

    def reading(self, true: int, draw: Callable[[int], np.ndarray]) -> int:
        """What the pin says where it should say ``true``."""
        if self.held is None:
            self.held = true
        match self.kind:
            case "stuck":
                return self.held
            case "jump":
                return true + round(self.jump)
            case "slip":
                return true - round(SLIP * (true - self.held))
            case "noisy":
                return true + round(self.deviation * float(draw(1)[0]))
        return 0  # dead


class SensorFaults:
    """What is wrong with the sensors of a robot's joints. ``active`` tells whether ``apply`` has anything to do."""

    def __init__(self, robot: Robot, streams: Callable[[str], Any]) -> None:
        self._joints: Sequence[Joint] = robot.joints
        self._noise = streams("plant.joints.faults")
        self._faults: dict[tuple[int, int], _Fault] = {}
        self._warmer: dict[int, int] = {}  # by joint, counts
        self._late: dict[int, int] = {}  # by joint, µs
        self.active = False

    def set(self, joint: int, key: str, value: Any) -> None:
        """Set a key of ``plant.config.JointFaults`` that is a sensor's. Raises KeyError for another one."""
        if key in _SENSORS:
            pin = _SENSORS[key]
            self._faults.pop((joint, pin), None)
            if value != "ok":
                self._faults[joint, pin] = _Fault(joint, pin, value, *self._amounts(joint, pin))
        elif key == "heating":
            self._keep(self._warmer, joint, round(value / pins.KELVIN_PER_COUNT))
        elif key == "isr_time":
            self._keep(self._late, joint, round(1e6 * value))
        else:
            raise KeyError(key)
        self.active = bool(self._faults or self._warmer or self._late)

    def _keep(self, table: dict[int, int], joint: int, value: int) -> None:
        table.pop(joint, None)
        if value:
            table[joint] = value

    def _amounts(self, joint: int, pin: int) -> tuple[float, float]:
        """Counts of a jump, and the deviation of noise."""
        of = self._joints[joint]
        if pin == pins.CURRENT_ADC:
            scale = of.actuator.current_limit / pins.AMPERE_PER_COUNT
            return CURRENT_JUMP * scale, CURRENT_NOISE * scale
        scale = {
            pins.MOTOR_ENCODER: of.sensor.encoder,
            pins.SPRING_ENCODER: of.spring_counts_per_rad,
            pins.JOINT_ENCODER: of.sensor.joint_encoder,
        }[pin]
        return JUMP * scale, NOISE * scale

    def apply(self, inputs: np.ndarray) -> None:
        """Change what the drives' pins ``inputs`` (joints, N_INPUTS) say."""
        for fault in self._faults.values():
            inputs[fault.joint, fault.pin] = fault.reading(int(inputs[fault.joint, fault.pin]), self._noise.normal)
        for joint, counts in self._warmer.items():
            inputs[joint, pins.TEMPERATURE_ADC] += counts
        for joint, time in self._late.items():
            inputs[joint, pins.ISR_TIMER] = time

    def snapshot(self) -> Any:
        faults = [(vars(fault).copy()) for fault in self._faults.values()]
        return self._noise.snapshot(), faults, dict(self._warmer), dict(self._late)

    def restore(self, state: Any) -> None:
        noise, faults, warmer, late = state
        self._noise.restore(noise)
        self._faults = {(fault["joint"], fault["pin"]): _Fault(**fault) for fault in faults}
        self._warmer, self._late = dict(warmer), dict(late)
        self.active = bool(self._faults or self._warmer or self._late)
