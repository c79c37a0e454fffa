"""A drive with all of its protection, on its actuator and a load: soft stops, braking, and no trip without a fault."""

from typing import Any

import pytest

from bus import messages
from bus.drive_faults import DriveFault
from bus.frames import Frame
from bus.messages import Controlword, Mode, Setpoint
from hil.compiled import compile_function
from hil.streams import streams
from joint_firmware.config import FirmwareConfig
from joint_firmware.drive import DriveState
from joint_firmware.firmware import JointFirmware
from plant.bench import Bench, Inertia
from plant.config import SensorConfig
from robots import description, pins

HUME = description.load("hume")
STEPS = 4  # of physics per interrupt


class ProtectedJoint:
    """The left knee with a flywheel, enabled; ``run`` commands it every second interrupt, as a controller does."""

    def __init__(self, at: float = 0.0, damping: str = "0.5 N m s/rad", **config: Any) -> None:
        joint = HUME.joint_names.index("left_knee")
        load = Inertia(inertia="0.5 kg m2", damping=damping, at=f"{at} rad")  # type: ignore[arg-type]
        self.firmware = JointFirmware(HUME, joint, FirmwareConfig(**config), compile_function)
        rate = self.firmware.settings.config.rate * STEPS
        self.bench = Bench(HUME, joint, load, rate, SensorConfig(), streams(3), compile=compile_function)
        self.firmware.attach(self.bench.pins_in, self.bench.pins_out)
        self.counter = 0
        for word in (0, Controlword.SHUTDOWN, Controlword.SWITCH_ON):
            self.run(0.03, word)

    def run(
        self, seconds: float, word: int = Controlword.ENABLE_OPERATION, silent: bool = False, **setpoint: Any
    ) -> None:
        for tick in range(round(3000 * seconds)):
            frames = []
            if tick % 2 == 0 and not silent:
                self.counter += 1
                slots = [Setpoint(word, Mode.TORQUE, **setpoint)] * messages.SLOTS
                frames.append(Frame(messages.COMMAND, messages.encode_command(self.counter, slots)))
            self.bench.sample()
            self.bench.latch()
            self.firmware.tick(0, frames)
            for _ in range(STEPS):
                self.bench.step()


def test_a_soft_stop_holds_what_its_stiffness_can_and_no_more() -> None:
    """Upper limit 3.4907 rad, 200 N m/rad: 20 N m come to rest 0.1 rad beyond, 60 N m pass the margin of 0.2 rad."""
    joint = ProtectedJoint(at=3.4)
    joint.run(3.0, torque=20.0)
    assert joint.firmware.state is DriveState.OPERATION_ENABLED
    assert joint.bench.position - 3.4907 == pytest.approx(0.1, abs=0.02)  # friction holds the rest
    joint.run(1.0, torque=60.0)
    assert joint.firmware.fault is DriveFault.POSITION_LIMIT and joint.firmware.state is DriveState.FAULT
    assert joint.bench.pins_out[pins.ENABLE] == 0


def test_braking_stops_a_turning_joint_sooner_than_friction_alone() -> None:
    """The motor's velocity is damped; the load swings on the spring, but goes hardly more than half as far."""
    ways = {}
    for key, state in (("joint_encoder", DriveState.FAULT_REACTION_ACTIVE), ("encoder", DriveState.FAULT)):
        joint = ProtectedJoint(damping="0.01 N m s/rad")
        joint.run(0.15, torque=15.0)
        start = joint.bench.position
        assert joint.bench.velocity > 2.0 and joint.firmware.state is DriveState.OPERATION_ENABLED
        joint.bench.faults.set(0, key, "jump")
        way = 0.0
        for _ in range(30):
            joint.run(0.01, silent=True)
            way = max(way, joint.bench.position - start)
        assert joint.firmware.state is state
        ways[key] = way
    assert 0.05 < ways["joint_encoder"] < 0.6 * ways["encoder"]


@pytest.mark.parametrize(
    ("fault", "at", "load", "limits"),
    [
        (DriveFault.OVER_TORQUE, 0.0, 300.0, {}),
        (DriveFault.POSITION_LIMIT, 3.2, 60.0, {}),
        # beyond the no-load speed the motor brakes as a generator: at 1.5 of it torque or position trips first
        (DriveFault.OVER_SPEED, -0.3, 100.0, {"over_speed": 1.0}),
    ],
)
def test_a_load_from_outside_that_a_drive_cannot_hold_makes_it_trip(
    fault: DriveFault, at: float, load: float, limits: dict[str, float]
) -> None:
    joint = ProtectedJoint(at=at, protection=limits)
    joint.run(0.05)
    assert not joint.firmware.fault
    joint.bench.faults.set(0, "load", load)
    for _ in range(600):
        joint.run(0.001)
        if joint.firmware.fault:
            break
    assert joint.firmware.fault is fault
    brakes = fault is DriveFault.OVER_SPEED
    assert joint.firmware.state is (DriveState.FAULT_REACTION_ACTIVE if brakes else DriveState.FAULT)
    demand, enabled = joint.bench.pins_out[pins.CURRENT_DEMAND], joint.bench.pins_out[pins.ENABLE]
    assert (demand * joint.bench.velocity < 0 and enabled) if brakes else (demand, enabled) == (0, 0)


@pytest.mark.parametrize("law", ["PD_m", "PID_m", "PD_m+DOB", "cascade", "PD_f"])
def test_no_law_makes_the_protection_trip(law: str) -> None:
    """Steps of up to a third of the torque limit, forth and back, with friction and noise."""
    joint = ProtectedJoint(at=1.5, damping="5 N m s/rad", law=law)
    peaks = joint.firmware.keep_peaks(compile_function)
    for n in range(20):
        joint.run(0.05, torque=(50.0, -50.0, 0.0, 25.0, -25.0)[n % 5])
        assert not joint.firmware.fault, joint.firmware.fault
    assert joint.firmware.state is DriveState.OPERATION_ENABLED
    compared = [DriveFault.MOTOR_ENCODER, DriveFault.SPRING_ENCODER, DriveFault.JOINT_ENCODER,
                DriveFault.ENCODER_MISMATCH, DriveFault.SPRING]  # fmt: skip
    assert max(peaks[fault - 1] for fault in compared) < 0.5
