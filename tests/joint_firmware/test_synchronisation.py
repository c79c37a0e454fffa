"""Where the joint is after power-on: quadrature counts from zero, an absolute encoder, and its calibrated offset."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus import messages
from bus.frames import Frame
from bus.messages import Controlword
from joint_firmware.config import FirmwareConfig, JointConfig, Settings
from joint_firmware.firmware import JointFirmware
from joint_firmware.laws import signals as law
from joint_firmware.object_dictionary import AbortCode, SdoAbort
from joint_firmware.synchronisation import SAMPLES, Synchronisation
from robots import description, pins

JOINTS = [(description.load("hume"), 1), (description.load("vlca"), 0)]
HIP = JOINTS[0][0].joints[1]
COUNT = 1.0 / HIP.sensor.joint_encoder  # rad of the absolute encoder: 16 bit per turn


class Powered:
    """A drive whose motor's counter was at zero with the joint at ``start`` [rad] and its spring under ``torque``.

    ``mounting`` [rad] is what the absolute encoder reads at 0, ``known`` what the drive takes for it.
    """

    def __init__(
        self, robot: Any = JOINTS[0][0], index: int = 1, start: float = 0.0, torque: float = 0.0,
        mounting: float = 0.0, known: float = 0.0,
    ) -> None:  # fmt: skip
        self.joint = joint = robot.joints[index]
        own = {joint.name: JointConfig(encoder_offset=f"{known!r} rad")}
        self.firmware = JointFirmware(robot, index, FirmwareConfig(joints=own))
        self.inputs, self.outputs = np.zeros(pins.N_INPUTS, np.int32), np.zeros(pins.N_OUTPUTS, np.int32)
        self.inputs[pins.SUPPLY_ADC] = round(joint.actuator.supply_voltage / pins.VOLT_PER_COUNT)
        self.firmware.attach(self.inputs, self.outputs)
        self.mounting, self._zero = mounting, 0.0
        self._zero = self._motor(start, torque)
        self.move(start, torque)

    def _motor(self, q: float, torque: float) -> float:
        actuator = self.joint.actuator
        output = q if actuator.linkage is None else float(actuator.linkage.motor_coordinate(q))
        ratio = 1.0 if actuator.linkage is None else float(actuator.linkage.ratio(q))
        self.deflection = torque / ratio / actuator.stiffness
        return output + self.deflection - self._zero

    def move(self, q: float, torque: float = 0.0) -> None:
        sensor = self.joint.sensor
        self.inputs[pins.MOTOR_ENCODER] = round(self._motor(q, torque) * sensor.encoder)
        self.inputs[pins.SPRING_ENCODER] = round(self.deflection * self.joint.spring_counts_per_rad)
        self.inputs[pins.JOINT_ENCODER] = round((q + self.mounting) * sensor.joint_encoder)

    def tick(self, *frames: Frame) -> list[Frame]:
        return self.firmware.tick(0, frames)

    def boot(self) -> Powered:
        while self.firmware.state.name == "NOT_READY":
            self.tick()
        return self

    @property
    def position(self) -> float:
        return self.firmware.y[law.Y_POSITION_SI]

    @property
    def resolution(self) -> float:
        """How well two encoders and the spring's tell the position, rad."""
        sensor = self.joint.sensor
        scales = (sensor.encoder, self.joint.spring_counts_per_rad, sensor.joint_encoder)
        return sum(1.5 / abs(scale) for scale in scales)


@given(st.sampled_from(JOINTS), st.floats(0, 1), st.floats(0, 1), st.floats(-30, 30), st.floats(-2, 2))
def test_the_position_is_the_joint_s_wherever_power_came_on(which, start, end, torque, mounting):
    robot, index = which
    low, high = robot.joints[index].limits
    q0, q1 = low + start * (high - low), low + end * (high - low)
    drive = Powered(robot, index, q0, torque, mounting, known=mounting).boot()
    assert drive.position == pytest.approx(q0, abs=drive.resolution)
    drive.move(q1)  # the spring relaxes meanwhile
    drive.inputs[pins.JOINT_ENCODER] = 0  # from here on, counts accumulate (Kim 2018 §5.4.1)
    drive.tick()
    assert drive.position == pytest.approx(q1, abs=2 * drive.resolution)


def test_the_mean_of_a_noisy_absolute_encoder_is_finer_than_its_counts():
    rng = np.random.default_rng(7)
    q, settings, errors = 0.3217, Settings(FirmwareConfig(), HIP), {1: [], SAMPLES: []}
    for samples, found in errors.items():
        for _ in range(200):
            synchronisation = Synchronisation(samples)
            while not synchronisation.done:
                inputs = [0] * pins.N_INPUTS
                inputs[pins.JOINT_ENCODER] = round(q / COUNT + 0.5 * rng.normal())
                synchronisation.add(inputs, settings)
            found.append(-synchronisation.motor_offset - q)  # the counter is at 0
    single, mean = (np.std(found) / COUNT for found in errors.values())
    assert single == pytest.approx(np.hypot(0.5, 1 / np.sqrt(12)), rel=0.15)  # noise and rounding
    assert mean == pytest.approx(single / np.sqrt(SAMPLES), rel=0.2)


@pytest.mark.parametrize("boot_time", ["0 s", "1 ms", "20 ms"])
def test_a_drive_is_referenced_before_it_can_be_switched_on(boot_time):
    robot, index = JOINTS[0]
    firmware = JointFirmware(robot, index, FirmwareConfig(boot_time=boot_time))
    inputs = np.zeros(pins.N_INPUTS, np.int32)
    firmware.attach(inputs, np.zeros(pins.N_OUTPUTS, np.int32))
    assert not firmware.referenced
    for _ in range(100):
        firmware.tick(0, [])
        if firmware.state.name != "NOT_READY":
            break
    assert firmware.state.name == "SWITCH_ON_DISABLED" and firmware.referenced


def test_a_wrong_offset_puts_the_joint_elsewhere():
    assert Powered(start=0.4, mounting=0.05, known=0.0).boot().position == pytest.approx(0.45, abs=1e-4)


def test_resetting_the_node_synchronises_it_anew():
    drive = Powered(start=0.2, mounting=0.3, known=0.3).boot()
    drive.move(0.7)
    drive.inputs[pins.MOTOR_ENCODER] += 12345  # it has lost counts meanwhile
    drive.tick()
    assert abs(drive.position - 0.7) > 0.1
    drive.tick(Frame(messages.NMT, bytes([0x81, HIP.node_id])))
    assert not drive.firmware.referenced
    assert drive.boot().position == pytest.approx(0.7, abs=drive.resolution)


@given(st.integers(0, 70))
def test_a_snapshot_at_any_interrupt_of_the_boot_goes_on_alike(at):
    drives = [Powered(start=0.2, torque=5.0, mounting=0.1, known=0.1) for _ in range(2)]
    rng = np.random.default_rng(at)
    noise = rng.integers(-3, 4, 90)
    encoder = int(drives[0].inputs[pins.JOINT_ENCODER])

    def run(drive, ticks):
        for n in ticks:
            drive.inputs[pins.JOINT_ENCODER] = encoder + noise[n]
            drive.tick()

    run(drives[0], range(at))
    drives[1].firmware.restore(drives[0].firmware.snapshot())
    for drive in drives:
        run(drive, range(at, 90))
    assert drives[0].position == drives[1].position
    assert drives[0].firmware.settings == drives[1].firmware.settings


# --- by SDO ---------------------------------------------------------------------------------------------------


def upload(drive: Powered, sub: int) -> float:
    return struct.unpack("<f", drive.firmware.dictionary.read(0x2020, sub))[0]


@given(st.sampled_from(JOINTS), st.floats(0, 1), st.floats(-0.2, 0.2))
def test_an_offset_that_a_master_writes_acts_at_once(which, share, wrong):
    robot, index = which
    low, high = robot.joints[index].limits
    q = low + 0.3 + share * (high - low - 0.6)
    drive = Powered(robot, index, q, 10.0, mounting=0.5, known=0.5 + wrong).boot()
    assert drive.position == pytest.approx(q - wrong, abs=drive.resolution)
    assert upload(drive, 7) == pytest.approx(q + 0.5, abs=drive.resolution)
    drive.firmware.dictionary.write(0x2020, 6, struct.pack("<f", 0.5))
    drive.tick()
    assert upload(drive, 6) == pytest.approx(0.5)
    assert drive.position == pytest.approx(q, abs=2 * drive.resolution)


def test_an_offset_is_not_changed_under_power():
    drive = Powered().boot()
    way = Controlword.SHUTDOWN, Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION
    for counter, word in enumerate(way, start=1):
        slots = [messages.Setpoint(word)] * messages.SLOTS
        drive.tick(Frame(messages.COMMAND, messages.encode_command(counter, slots)))
    assert drive.firmware.powered
    with pytest.raises(SdoAbort) as caught:
        drive.firmware.dictionary.write(0x2020, 6, struct.pack("<f", 0.1))
    assert caught.value.code == AbortCode.DEVICE_STATE
