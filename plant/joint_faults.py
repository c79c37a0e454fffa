"""What is wrong with joints: sensors that lie on the pins behind their models, supplies, springs, friction, loads.

Nothing here is called in a tick while all is well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from plant.actuators.bank import ActuatorBank
from plant.actuators.model import ActuatorModel
from robots import pins
from robots.description import Joint, Robot

JUMP, NOISE = 0.1, 0.005  # rad: of a jump, and the deviation of the noise of an encoder
CURRENT_JUMP, CURRENT_NOISE = 2.5, 0.5  # the same of a current sensor, of its drive's current limit
SLIP = 0.5  # share of its counts that a slipping encoder loses

_SENSORS = {
    "encoder": pins.MOTOR_ENCODER,
    "spring_encoder": pins.SPRING_ENCODER,
    "joint_encoder": pins.JOINT_ENCODER,
    "current_sensor": pins.CURRENT_ADC,
}
_SPRING = ("stiffness", "damping")


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


class FaultyJoints:
    """The faults of ``plant.config.JointFaults`` in the joints of a robot and their actuators ``bank``.

    ``on_pins`` tells whether ``apply`` has anything to do, ``loaded`` whether ``load`` [N m] is on any joint.
    """

    def __init__(self, robot: Robot, bank: ActuatorBank, streams: Callable[[str], Any]) -> None:
        self._joints: Sequence[Joint] = robot.joints
        self._bank = bank
        self._noise = streams("plant.joints.faults")
        self._nominal = [{name: bank.get(k, name) for name in bank.parameters(k)} for k in range(len(robot.joints))]
        self._faults: dict[tuple[int, int], _Fault] = {}
        self._warmer: dict[int, int] = {}  # by joint, counts
        self._late: dict[int, int] = {}  # by joint, µs
        self.load = np.zeros(len(robot.joints))
        self.on_pins = self.loaded = False

    def set(self, joint: int, key: str, value: Any) -> None:
        """Set a key of ``JointFaults``, in SI units. Raises KeyError for one that is not the plant's."""
        of = self._joints[joint]
        if key in _SENSORS:
            pin = _SENSORS[key]
            self._faults.pop((joint, pin), None)
            if value != "ok":
                self._faults[joint, pin] = _Fault(joint, pin, value, *_amounts(of, pin))
        elif key == "heating":
            _keep(self._warmer, joint, round(value / pins.KELVIN_PER_COUNT))
        elif key == "isr_time":
            self._late[joint] = round(1e6 * value)
        elif key == "supply":
            self._bank.supply[joint] = value * of.actuator.supply_voltage
        elif key == "load":
            self.load[joint] = value
        elif key == "spring":
            self._scale(joint, _SPRING, value)
        elif key == "friction":
            self._scale(joint, ActuatorModel.of(of.actuator).friction, value)
        else:
            raise KeyError(key)
        self._look()

    def _look(self) -> None:
        """Find out whether there is anything to do."""
        self.on_pins = bool(self._faults or self._warmer or self._late)
        self.loaded = bool(self.load.any())

    def _scale(self, joint: int, names: Sequence[str], share: float) -> None:
        """Set those of these parameters that the joint's actuator has to ``share`` of their own values."""
        for name in names:
            if name in self._nominal[joint]:
                self._bank.set(joint, name, share * self._nominal[joint][name])

    def apply(self, inputs: np.ndarray) -> None:
        """Change what the drives' pins ``inputs`` (joints, N_INPUTS) say."""
        for fault in self._faults.values():
            inputs[fault.joint, fault.pin] = fault.reading(int(inputs[fault.joint, fault.pin]), self._noise.normal)
        for joint, counts in self._warmer.items():
            inputs[joint, pins.TEMPERATURE_ADC] += counts
        for joint, time in tuple(self._late.items()):
            inputs[joint, pins.ISR_TIMER] = time
            if not time:  # written once: no sensor model writes this pin
                del self._late[joint]
                self._look()

    def snapshot(self) -> Any:
        """What the bank's own snapshot does not hold."""
        faults = [vars(fault).copy() for fault in self._faults.values()]
        return self._noise.snapshot(), faults, dict(self._warmer), dict(self._late), self.load.copy()

    def restore(self, state: Any) -> None:
        noise, faults, warmer, late, load = state
        self._noise.restore(noise)
        self._faults = {(fault["joint"], fault["pin"]): _Fault(**fault) for fault in faults}
        self._warmer, self._late = dict(warmer), dict(late)
        self.load[:] = load
        self._look()


def _keep(table: dict[int, int], joint: int, value: int) -> None:
    table.pop(joint, None)
    if value:
        table[joint] = value


def _amounts(joint: Joint, pin: int) -> tuple[float, float]:
    """Counts of a jump, and the deviation of noise."""
    if pin == pins.CURRENT_ADC:
        scale = joint.actuator.current_limit / joint.actuator.ampere_per_count
        return CURRENT_JUMP * scale, CURRENT_NOISE * scale
    scale = {
        pins.MOTOR_ENCODER: joint.sensor.encoder,
        pins.SPRING_ENCODER: joint.spring_counts_per_rad,
        pins.JOINT_ENCODER: joint.sensor.joint_encoder,
    }[pin]
    return JUMP * scale, NOISE * scale
