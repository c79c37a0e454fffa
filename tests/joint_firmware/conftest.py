"""One drive on a bench: its pins, its frames, its controller's counter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bus import messages
from bus.frames import Frame
from bus.messages import Controlword, GainSet, Mode, Setpoint, State
from joint_firmware.config import FirmwareConfig
from joint_firmware.drive import DriveState
from joint_firmware.firmware import JointFirmware
from robots import description, pins

HUME = description.load("hume")
# Here pins are set from nowhere, and no current flows: monitors that compare sensors with each other would trip
UNWATCHED = {
    **dict.fromkeys(("encoder_jump", "encoder_stuck", "encoder_mismatch"), "1e6 rad"),
    **dict.fromkeys(("current_error", "spring_error", "over_speed"), 1e6),
}


class Bench:
    """A drive, alone. ``tick`` is one interrupt; a command goes to the drive's slot of the bus's frame."""

    def __init__(self, joint: str = "right_hip", compile: Any = lambda f: f, **config: Any) -> None:
        self.joint = HUME.joint(joint)
        self.config = FirmwareConfig(**{"protection": UNWATCHED, **config})
        self.firmware = JointFirmware(HUME, HUME.joint_names.index(joint), self.config, compile)
        self.slot = next(bus.joints.index(joint) for bus in HUME.buses if joint in bus.joints)
        self.inputs = np.zeros(pins.N_INPUTS, np.int32)
        self.inputs[pins.SUPPLY_ADC] = round(self.joint.actuator.supply_voltage / pins.VOLT_PER_COUNT)
        self.outputs = np.full(pins.N_OUTPUTS, -1, np.int32)
        self.firmware.attach(self.inputs, self.outputs)
        self.counter = 0
        self.report: State | None = None
        self.emergencies: list[tuple[int, int, bytes]] = []

    @property
    def state(self) -> DriveState:
        return self.firmware.state

    @property
    def enabled(self) -> int:
        return int(self.outputs[pins.ENABLE])

    @property
    def motor_torque(self) -> float:
        """Demanded motor torque seen from the joint, N m."""
        amperes = int(self.outputs[pins.CURRENT_DEMAND]) * pins.AMPERE_PER_COUNT
        return amperes * self.joint.actuator.torque_per_ampere

    @property
    def resolution(self) -> float:
        """Motor torque of one count of current, N m."""
        return pins.AMPERE_PER_COUNT * self.joint.actuator.torque_per_ampere

    def place(self, position: float = 0.0, torque: float = 0.0) -> None:
        """Pins of a joint at ``position`` [rad] whose spring holds ``torque`` [N m]."""
        deflection = torque / self.joint.actuator.stiffness
        self.inputs[pins.SPRING_ENCODER] = round(deflection * self.joint.spring_counts_per_rad)
        self.inputs[pins.MOTOR_ENCODER] = round((position + deflection) * self.joint.sensor.encoder)
        self.inputs[pins.JOINT_ENCODER] = round(position * self.joint.sensor.joint_encoder)

    def frame(self, word: int, mode: int = Mode.TORQUE, counter: int | None = None, **setpoint: Any) -> Frame:
        """The next command frame, or that of ``counter``; other slots ask for what would be noticed."""
        if counter is None:
            counter = self.counter = self.counter + 1 & 0xFFFF
        slots = [Setpoint(Controlword.QUICK_STOP, Mode.DAMPING, GainSet.SWING, 77.0)] * messages.SLOTS
        slots[self.slot] = Setpoint(word, mode, **setpoint)
        return Frame(messages.COMMAND, messages.encode_command(counter, slots))

    def tick(self, *frames: Frame) -> list[Frame]:
        sent = self.firmware.tick(0, frames)
        for frame in sent:
            if frame.id == messages.STATE + self.joint.node_id:
                self.report = messages.decode_state(frame.data)
            if frame.id == messages.EMERGENCY + self.joint.node_id:
                self.emergencies.append(messages.decode_emergency(frame.data))
        return sent

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.tick()

    def command(
        self, word: int = Controlword.ENABLE_OPERATION, mode: int = Mode.TORQUE, **setpoint: Any
    ) -> None:
        self.tick(self.frame(word, mode, **setpoint))

    def boot(self) -> Bench:
        while self.state == DriveState.NOT_READY:
            self.tick()
        return self

    def enable(self, mode: int = Mode.TORQUE, **setpoint: Any) -> Bench:
        """Boot and switch on; the last command is in force."""
        self.boot()
        for word in (Controlword.SHUTDOWN, Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION):
            self.command(word, mode, **setpoint)
        assert self.state == DriveState.OPERATION_ENABLED
        return self


@pytest.fixture(scope="session")
def bench() -> type[Bench]:
    return Bench
