"""Each monitor of the drive's law by numbers worked out beside it: the tick in which it trips, and that in which not.

Pins are those of a joint that exists: three encoders that agree, a current that is the demanded one. Then one lies.
"""

import math

import canopen
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from bus import messages
from bus.drive_faults import DriveFault
from bus.frames import Frame
from bus.messages import Controlword, Mode
from hil.compiled import compile_function
from joint_firmware.config import FirmwareConfig
from joint_firmware.drive import DriveState
from joint_firmware.laws import drive_law, signals
from joint_firmware.protection_config import ProtectionConfig
from robots import description, pins

from .canopen_rig import GAINS, Rig
from .conftest import UNWATCHED

HUME = description.load("hume")
ENABLE = Controlword.ENABLE_OPERATION
DT = 1.0 / 3000.0
MRAD = 1e-3
STOP_TICKS = 1500  # 0.5 s of braking
CURRENT_LIMIT = 27.5  # A, of hip and knee (robots/hume.toml)
TORQUE_PER_AMPERE = 6.0  # N m/A of the hip: 120 times 0.05 N m/A
SCALES = {
    pins.MOTOR_ENCODER: lambda joint: joint.sensor.encoder,
    pins.SPRING_ENCODER: lambda joint: joint.spring_counts_per_rad,
    pins.JOINT_ENCODER: lambda joint: joint.sensor.joint_encoder,
}
# A motion that nothing drives, as far as it may go
UNEXPLAINED = {"spring_error": 1e6, "position_margin": "1000 rad"}
ENCODERS = {
    pins.MOTOR_ENCODER: (DriveFault.MOTOR_ENCODER, 0x7305, DriveState.FAULT),
    pins.SPRING_ENCODER: (DriveFault.SPRING_ENCODER, 0x7306, DriveState.FAULT_REACTION_ACTIVE),
    pins.JOINT_ENCODER: (DriveFault.JOINT_ENCODER, 0x7320, DriveState.FAULT_REACTION_ACTIVE),
}


class Joint:
    """A drive whose sensors all see one joint at ``q`` [rad] with ``deflection`` [rad].

    ``lies`` adds to what they say."""

    def __init__(self, bench, joint="right_hip", at=0.0, **config):
        config.setdefault("protection", {})
        self.drive = bench(joint, compile_function, **config)
        self.q, self.deflection = at, 0.0
        self.lies: dict[int, float] = {}  # rad, or A of the current
        self.frozen: dict[int, int] = {}  # counts
        self.current: float | None = None  # A that flows; None: what the drive demands
        self.sense()
        self.drive.enable()

    def sense(self):
        drive = self.drive
        angles = {
            pins.MOTOR_ENCODER: self.q + self.deflection,
            pins.SPRING_ENCODER: self.deflection,
            pins.JOINT_ENCODER: self.q,
        }
        for pin, angle in angles.items():
            drive.inputs[pin] = round((angle + self.lies.get(pin, 0.0)) * SCALES[pin](drive.joint))
        demanded = int(drive.outputs[pins.CURRENT_DEMAND]) if drive.enabled == 1 else 0
        amperes = demanded * pins.AMPERE_PER_COUNT if self.current is None else self.current
        drive.inputs[pins.CURRENT_ADC] = round(amperes / pins.AMPERE_PER_COUNT)
        for pin, counts in self.frozen.items():
            drive.inputs[pin] = counts

    def ticks(self, n=1, velocity=0.0, **setpoint):
        """``n`` interrupts with commands, the joint moving at ``velocity`` [rad/s]; stops at the first fault.

        Returns how many it took."""
        for done in range(1, n + 1):
            self.q += velocity * DT
            self.sense()
            self.drive.command(**setpoint)
            if self.fault:
                return done
        return n

    @property
    def fault(self):
        return self.drive.firmware.fault

    def is_off(self):
        drive = self.drive
        return drive.state is DriveState.FAULT and not drive.enabled and drive.outputs[pins.CURRENT_DEMAND] == 0

    def brakes(self):
        """Whether it does, by 30 N m s/rad of the velocity that it reports."""
        drive = self.drive
        velocity = drive.firmware.y[signals.Y_MOTOR_VELOCITY] * messages.MOTOR_RADIAN_PER_SECOND
        full = CURRENT_LIMIT * TORQUE_PER_AMPERE
        wanted = min(max(-30.0 * velocity, -full), full)
        stops = drive.state in (DriveState.FAULT_REACTION_ACTIVE, DriveState.QUICK_STOP_ACTIVE)
        return stops and drive.enabled == 1 and drive.motor_torque == pytest.approx(wanted, abs=1.5 * drive.resolution)

    def told(self):
        return [(code, register) for code, register, _ in self.drive.emergencies]


@pytest.fixture
def joint(bench):
    return lambda name="right_hip", **config: Joint(bench, name, **config)


# --- encoders -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pin", ENCODERS)
@pytest.mark.parametrize("velocity", [0.0, -3.0])
def test_an_encoder_that_jumps_against_the_others_is_told_in_that_interrupt(joint, pin, velocity):
    fault, code, state = ENCODERS[pin]
    below = joint()
    below.ticks(30, velocity)
    below.lies[pin] = 2.5 * MRAD  # of 3 mrad, and counts of up to 0.2 mrad
    assert below.ticks(2, velocity) == 2 and not below.fault
    above = joint()
    above.ticks(30, velocity)
    above.lies[pin] = 3.5 * MRAD
    assert above.ticks(1, velocity) == 1
    assert above.fault is fault and above.drive.state is state and above.told() == [(code, 0x21)]
    assert above.is_off() if state is DriveState.FAULT else above.brakes()


@pytest.mark.parametrize("pin", ENCODERS)
def test_an_encoder_that_stands_still_while_the_others_move_is_found(joint, pin):
    moving = joint()
    moving.ticks(30)
    moving.frozen[pin] = int(moving.drive.inputs[pin])
    done = 0
    while not moving.fault and done < 300:
        moving.q += 1.0 * DT  # a joint that turns at 1 rad/s,
        moving.deflection += 0.5 * DT  # driven by a spring that is wound up
        done += moving.ticks()
    fault, code, _ = ENCODERS[pin]
    rate = {pins.MOTOR_ENCODER: 1.5, pins.SPRING_ENCODER: 0.5, pins.JOINT_ENCODER: 1.0}[pin]
    expected = 5 * MRAD / rate / DT + 9  # 5 mrad, and then 3 ms
    assert moving.fault is fault and moving.told() == [(code, 0x21)]
    assert done == pytest.approx(expected, abs=3)


def test_encoders_that_drift_apart_while_all_of_them_count_are_a_mismatch(joint):
    drifting = joint()
    done = 0
    while not drifting.fault and done < 2000:
        done += 1
        drifting.lies[pins.MOTOR_ENCODER] = -0.1 * DT * done  # loses 0.1 rad in a second
        drifting.deflection = 2 * MRAD * math.sin(200 * DT * done)
        drifting.ticks(1, velocity=1.0)
    assert drifting.fault is DriveFault.ENCODER_MISMATCH and drifting.is_off() and drifting.told() == [(0x7300, 0x21)]
    assert done == pytest.approx(10 * MRAD / 0.1 / DT + 9, abs=10)  # 10 mrad, and then 3 ms


def test_a_constant_error_of_the_calibration_is_no_fault_of_an_encoder(joint):
    offset = joint()
    drive = offset.drive
    drive.command(Controlword.DISABLE_VOLTAGE)
    drive.firmware.configure(motor_offset=0.2)
    drive.enable()
    assert offset.ticks(300, velocity=1.0) == 300 and not offset.fault


@settings(max_examples=25)
@given(
    st.lists(st.tuples(st.floats(-9, 9), st.floats(-150, 150)), min_size=2, max_size=6), st.floats(-1, 1)
)  # fmt: skip
def test_no_motion_of_a_sound_joint_is_a_fault(bench, legs, start):
    """Up to 9 rad/s and 150 N m, reached within 10 ms: 1800 rad/s² and 30 kN m/s."""
    moving = Joint(bench, at=start, protection={**UNEXPLAINED, "over_speed": 1e6})
    velocity = torque = 0.0
    for next_velocity, next_torque in legs:
        for n in range(30):
            share = (n + 1) / 30
            moving.deflection = (torque + share * (next_torque - torque)) / moving.drive.joint.actuator.stiffness
            moving.ticks(1, velocity + share * (next_velocity - velocity))
        velocity, torque = next_velocity, next_torque
    assert not moving.fault


# --- current and spring ----------------------------------------------------------------------------------------


def test_a_measured_current_beyond_the_limit_for_a_millisecond_cuts_power(joint):
    only = {"current_error": 1e6, "spring_error": 1e6}
    below = joint(protection=only)
    below.current = 1.25 * CURRENT_LIMIT - 0.05
    assert below.ticks(50) == 50 and not below.fault
    brief = joint(protection=only)
    for _ in range(5):
        brief.current = -1.25 * CURRENT_LIMIT - 0.05
        brief.ticks(2)
        brief.current = 0.0
        brief.ticks(1)
    assert not brief.fault
    brief.current = -1.25 * CURRENT_LIMIT - 0.05
    assert brief.ticks(10) == 3
    assert brief.fault is DriveFault.OVER_CURRENT and brief.is_off() and brief.told() == [(0x2310, 0x03)]


def test_a_current_that_is_not_the_demanded_one_cuts_power(joint):
    """12 A are demanded, none is measured: 5 ms of filter reach 5.5 A after 3.1 ms, 20 ms later it trips."""
    dead = joint(protection={"spring_error": 1e6})
    dead.ticks(1, torque=18.0)  # (1 + kp) 18 N m from a relaxed spring: 12 A
    dead.current = 0.0
    done = dead.ticks(500, torque=18.0)
    expected = (0.005 * math.log(12 / (12 - 0.2 * CURRENT_LIMIT)) + 0.02) / DT
    assert dead.fault is DriveFault.CURRENT_SENSOR and dead.is_off() and dead.told() == [(0x7200, 0x03)]
    assert done == pytest.approx(expected, abs=5)


def test_a_motor_too_fast_for_its_supply_may_take_less_current_than_demanded(joint):
    fast = joint(protection=UNEXPLAINED)
    fast.ticks(30, velocity=5.0)  # a back-EMF of 30 V, of a supply of 48 V
    fast.current = 0.0
    assert fast.ticks(300, velocity=5.0, torque=18.0) == 300 and not fast.fault


@pytest.mark.parametrize("share, found", [(1.15, True), (0.97, False)])
def test_torque_that_neither_current_nor_spring_explains_is_a_broken_spring(joint, share, found):
    """The spring says ``share`` of a quarter of the motor's greatest torque, the motor gives none and stands."""
    torque = share * 0.25 * CURRENT_LIMIT * TORQUE_PER_AMPERE
    broken = joint(protection={"current_error": 1e6})
    broken.current = 0.0
    for n in range(120):  # wound up slowly enough for the spring's encoder
        broken.deflection = torque * min(n / 60, 1.0) / broken.drive.joint.actuator.stiffness
        broken.ticks()
    broken.ticks(1500)
    assert bool(broken.fault) is found
    if found:
        assert broken.fault is DriveFault.SPRING and broken.is_off() and broken.told() == [(0x8331, 0x21)]


# --- supply ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("edge, outward, ticks, fault, code", [
    (36.0, -1, 15, DriveFault.UNDER_VOLTAGE, 0x3220), (60.0, 1, 3, DriveFault.OVER_VOLTAGE, 0x3210),
])  # fmt: skip
def test_a_supply_out_of_range_for_its_time_cuts_power(joint, edge, outward, ticks, fault, code):
    supplied = joint()
    inputs = supplied.drive.inputs
    inputs[pins.SUPPLY_ADC] = 100 * (edge - 0.1 * outward)
    assert supplied.ticks(30) == 30 and not supplied.fault
    inputs[pins.SUPPLY_ADC] = 100 * (edge + 0.1 * outward)
    assert supplied.ticks(30) == ticks
    assert supplied.fault is fault and supplied.is_off() and supplied.told() == [(code, 0x05)]
    # back by less than a tenth of the way to the nominal voltage, it is still there
    inputs[pins.SUPPLY_ADC] = 100 * (edge - 1.1 * outward)
    for word in (0, 0x80, 0):
        supplied.drive.command(word)
    assert supplied.drive.state is DriveState.FAULT
    inputs[pins.SUPPLY_ADC] = 100 * (edge - 1.3 * outward)
    for word in (0, 0x80):
        supplied.drive.command(word)
    assert supplied.drive.state is DriveState.SWITCH_ON_DISABLED and supplied.told()[1:] == [(0, 0)]


# --- speed -----------------------------------------------------------------------------------------------------


def test_a_motor_half_as_fast_again_as_without_load_is_braked(joint):
    """No load: 48 V / 6 V s/rad = 8 rad/s."""
    below = joint(protection=UNEXPLAINED)
    assert below.ticks(300, velocity=11.8) == 300 and not below.fault
    above = joint(protection=UNEXPLAINED)
    done = above.ticks(300, velocity=-12.5)
    assert above.fault is DriveFault.OVER_SPEED and above.told() == [(0x8400, 0x21)] and above.brakes()
    assert above.drive.motor_torque == pytest.approx(CURRENT_LIMIT * TORQUE_PER_AMPERE)  # all that the motor has
    # a filter of 200 Hz passes 12 rad/s of 12.5 after 2.6 ms; then 5 ms
    assert done == pytest.approx((math.log(12.5 / 0.5) / (2 * math.pi * 200) + 0.005) / DT, abs=2)


# --- heat ------------------------------------------------------------------------------------------------------


def test_a_winding_too_hot_by_its_sensor_is_braked_and_must_cool_down(joint):
    hot = joint()
    inputs = hot.drive.inputs
    inputs[pins.TEMPERATURE_ADC] = 1549
    assert hot.ticks(60) == 60 and not hot.fault
    inputs[pins.TEMPERATURE_ADC] = 1551  # 155 °C: class F
    assert hot.ticks(60) == 30  # 10 ms
    assert hot.fault is DriveFault.OVER_TEMPERATURE and hot.told() == [(0x4310, 0x09)] and hot.brakes()
    hot.drive.run(STOP_TICKS)
    assert hot.is_off()
    inputs[pins.TEMPERATURE_ADC] = 1425  # more than nine tenths of the rise over 25 °C: 142 °C
    for word in (0, 0x80, 0):
        hot.drive.command(word)
    assert hot.drive.state is DriveState.FAULT
    inputs[pins.TEMPERATURE_ADC] = 1415
    for word in (0, 0x80):
        hot.drive.command(word)
    assert hot.drive.state is DriveState.SWITCH_ON_DISABLED


def law_at(rate, joint_name, current, **protection):
    """The law alone at ``rate`` [Hz], ``current`` [A] flowing: a call per tick, which returns states and trips."""
    joint = HUME.joint(joint_name)
    config = FirmwareConfig(
        rate=f"{rate} Hz", report_rate=f"{rate} Hz",
        protection={**UNWATCHED, "over_current": 1e6, **protection},
    )  # fmt: skip
    law = drive_law(joint, config)
    function, p = compile_function(law.function), law.values(joint, config)
    counts = np.zeros(pins.N_INPUTS)
    counts[pins.CURRENT_ADC] = current / pins.AMPERE_PER_COUNT
    counts[pins.SUPPLY_ADC], counts[pins.TEMPERATURE_ADC] = 4800, 250
    x, u = np.zeros(len(law.states)), np.zeros(signals.INPUT_SIZE)
    while True:
        after, y = function(counts, x, u, p)
        x = after.full().ravel()
        yield dict(zip(law.states, x, strict=True)), int(y[signals.Y_TRIPS])


def test_the_computed_temperatures_are_those_of_winding_and_housing():
    joint = HUME.joint("left_abduction")
    thermal, cold = joint.actuator.thermal, joint.actuator.motor.resistance

    def rates(_, temperatures):
        winding, housing = temperatures
        power = cold * (1 + 0.00393 * (winding - 25.0)) * 12.0**2
        across = (winding - housing) / thermal.winding_to_housing
        loss = (housing - 25.0) / thermal.housing_to_ambient
        return [
            (power - across) * thermal.winding_to_housing / thermal.winding_time_constant,
            (across - loss) * thermal.housing_to_ambient / thermal.housing_time_constant,
        ]

    seconds, rate = 200, 20
    exact = solve_ivp(rates, (0, seconds), [25.0, 25.0], rtol=1e-9).y[:, -1]
    law = law_at(rate, "left_abduction", 12.0)
    for _ in range(seconds * rate):
        x, _ = next(law)
    computed = x["winding_temperature"], x["housing_temperature"]
    assert computed == pytest.approx(exact, abs=0.05) and computed[0] > 40


@pytest.mark.parametrize("name", ["left_knee", "left_abduction"])
def test_overload_trips_when_more_than_full_current_would_have_warmed_the_winding_by_half(name):
    """Knee: 27.5 A would warm its winding by 65 K over a cold housing in 17 s. Abduction: 13 A never would, 430 s do of
    the housing for what is left."""
    actuator = HUME.joint(name).actuator
    thermal, full = actuator.thermal, actuator.current_limit
    hot = actuator.motor.resistance * (1 + 0.00393 * 130.0)  # Ω at 155 °C
    continuous = 130.0 / (hot * (thermal.winding_to_housing + thermal.housing_to_ambient))  # A²

    def winding(_, rise):
        return (hot * full**2 - rise / thermal.winding_to_housing) / thermal.winding_capacity

    over = solve_ivp(winding, (0, 1000), [0.0], events=(half := lambda _, rise: rise[0] - 65.0), rtol=1e-8)
    across = hot * full**2 * thermal.winding_to_housing
    if name == "left_knee":
        time = over.t_events[0][0]
    else:
        assert not len(over.t_events[0]) and half(0, over.y[:, -1]) < 0
        time = thermal.winding_time_constant + thermal.housing_capacity * (65.0 - across) / (hot * full**2)
    current, rate = 4.0 * full, 20
    expected = time * (full**2 - continuous) / (current**2 - continuous)
    law = law_at(rate, name, current, over_temperature=1e6)
    trips = ticks = 0
    while not trips and ticks < 2000:
        ticks += 1
        _, trips = next(law)
    assert trips == 1 << DriveFault.OVERLOAD
    assert ticks / rate == pytest.approx(expected, abs=2 / rate) and expected > 0.5


def test_what_may_flow_for_ever_is_no_overload():
    law = law_at(10, "left_abduction", 12.0, over_temperature=1e6)  # of 12.3 A
    assert not any(next(law)[1] for _ in range(3000))


# --- commands --------------------------------------------------------------------------------------------------


def nonsense(drive, **setpoint):
    """The next command frame, with a set-point that makes no sense."""
    frame = drive.frame(ENABLE, Mode.TORQUE, **setpoint)
    if not setpoint:
        data = bytearray(frame.data)
        messages.overwrite_torque(data, drive.slot, -(2**31))
        frame = frame._replace(data=bytes(data))
    return frame


@pytest.mark.parametrize("setpoint", [{}, {"torque": 700.0}, {"torque": -1e5}, {"position": 6.0}, {"velocity": -40.0}])
def test_set_points_without_sense_are_not_acted_upon_and_the_third_brakes(bench, setpoint):
    drive = bench().enable(torque=2.0)
    for _ in range(5):
        drive.command(torque=2.0)
    before = drive.motor_torque
    for _ in range(2):
        drive.tick(nonsense(drive, **setpoint))
        assert drive.state is DriveState.OPERATION_ENABLED and drive.motor_torque == before != 0
    drive.command(torque=2.0)  # two are borne
    for _ in range(2):
        drive.tick(nonsense(drive, **setpoint))
    assert drive.state is DriveState.OPERATION_ENABLED and drive.firmware.malformed == 4
    drive.tick(nonsense(drive, **setpoint))
    assert drive.state is DriveState.FAULT_REACTION_ACTIVE and drive.enabled == 1 and drive.motor_torque == 0.0
    assert drive.emergencies == [(0x8900, 0x21, bytes(5))]


@pytest.mark.parametrize("setpoint", [{"torque": 500.0}, {"position": -1.7}, {"velocity": 30.0}])
def test_set_points_far_beyond_what_the_drive_will_do_still_make_sense(bench, setpoint):
    drive = bench().enable()
    for _ in range(10):
        drive.command(mode=Mode.POSITION, **setpoint)
    assert drive.state is DriveState.OPERATION_ENABLED and drive.firmware.malformed == 0


def test_frames_without_sense_do_not_feed_the_watchdog(bench):
    drive = bench().enable()
    drive.run(12)
    drive.tick(nonsense(drive))
    drive.tick(nonsense(drive))
    assert drive.state is DriveState.OPERATION_ENABLED
    drive.tick()
    assert drive.state is DriveState.QUICK_STOP_ACTIVE and drive.emergencies[0][0] == 0x8130


def test_frames_without_sense_cannot_do_anything_to_a_drive_without_power(bench):
    drive = bench().boot()
    for _ in range(10):
        drive.tick(nonsense(drive))
    assert drive.state is DriveState.SWITCH_ON_DISABLED and not drive.emergencies and drive.enabled == 0


@pytest.mark.parametrize("index", [signals.U_TORQUE, signals.U_POSITION, signals.U_VELOCITY])
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e4])
def test_the_law_by_itself_brakes_on_a_set_point_that_is_no_number_or_out_of_range(index, value):
    """What is exported has no firmware around it."""
    joint = HUME.joint("right_hip")
    config = FirmwareConfig(protection=UNWATCHED)
    law = drive_law(joint, config)
    p, counts, u = law.values(joint, config), np.zeros(pins.N_INPUTS), np.zeros(signals.INPUT_SIZE)
    counts[pins.SUPPLY_ADC] = 4800
    u[[signals.U_TORQUE_MODE, signals.U_ENABLED, signals.U_KP]] = 1.0
    u[signals.U_LIMIT] = 100.0
    for function in (law.function, compile_function(law.function)):
        x = np.zeros(len(law.states))
        for offered in (0.0, 0.0, 0.0, 0.0, 0.0, value):
            counts[pins.MOTOR_ENCODER] += round(0.2 * DT * joint.sensor.encoder)
            u[index] = offered
            x, y = (result.full().ravel() for result in function(counts, x, u, p))
        assert int(y[signals.Y_TRIPS]) == 1 << DriveFault.COMMAND
        velocity = y[signals.Y_MOTOR_VELOCITY] * messages.MOTOR_RADIAN_PER_SECOND
        demand = -30.0 * velocity / TORQUE_PER_AMPERE / pins.AMPERE_PER_COUNT
        assert y[signals.Y_DEMAND] == pytest.approx(demand, abs=1.0) and abs(demand) > 50
        assert np.all(np.isfinite(x)) and np.all(np.isfinite(y))


# --- time ------------------------------------------------------------------------------------------------------


def test_interrupts_that_take_too_long_for_a_millisecond_cut_power(joint):
    slow = joint()
    slow.drive.inputs[pins.ISR_TIMER] = 299  # µs, of nine tenths of 333 µs
    assert slow.ticks(30) == 30 and not slow.fault
    slow.drive.inputs[pins.ISR_TIMER] = 302
    slow.ticks(2)
    slow.drive.inputs[pins.ISR_TIMER] = 100
    slow.ticks(1)
    assert not slow.fault
    slow.drive.inputs[pins.ISR_TIMER] = 302
    assert slow.ticks(30) == 3
    assert slow.fault is DriveFault.TIME_OVERRUN and slow.is_off() and slow.told() == [(0x6100, 0x81)]


# --- reactions --------------------------------------------------------------------------------------------------


def test_a_braking_reaction_lasts_as_a_quick_stop_whatever_is_commanded_and_ends_without_power(joint):
    braking = joint()
    braking.ticks(30, velocity=2.0)
    braking.lies[pins.JOINT_ENCODER] = 0.1
    braking.ticks(1, velocity=2.0)
    for n in range(STOP_TICKS - 1):
        assert braking.brakes(), n
        braking.q += 2.0 * DT * (n < 100)
        braking.sense()
        braking.drive.command((0, Controlword.QUICK_STOP, ENABLE, 0x80)[n % 4], torque=50.0)
    braking.sense()
    braking.drive.tick()
    assert braking.is_off() and braking.told() == [(0x7320, 0x21)]


def test_while_a_drive_brakes_only_what_braking_relies_on_cuts_power(joint):
    braking = joint()
    braking.lies[pins.SPRING_ENCODER] = 1.0  # which looks like 360 N m, and a joint 1 rad away
    braking.ticks()
    assert braking.brakes() and braking.told() == [(0x7306, 0x21)]
    for _ in range(100):
        braking.sense()
        braking.drive.tick()
        assert braking.brakes()
    braking.lies[pins.MOTOR_ENCODER] = 0.1
    braking.sense()
    braking.drive.tick()
    assert braking.is_off() and braking.told() == [(0x7306, 0x21), (0x7305, 0x21)]
    assert braking.drive.report.error == DriveFault.SPRING_ENCODER  # of the report before; the next has the new one
    braking.drive.run(2)
    assert braking.drive.report.error == DriveFault.MOTOR_ENCODER


def test_a_commanded_quick_stop_is_protected_too(joint):
    stopping = joint()
    stopping.drive.command(Controlword.QUICK_STOP)
    assert stopping.drive.state is DriveState.QUICK_STOP_ACTIVE
    stopping.drive.inputs[pins.SUPPLY_ADC] = 3000
    for _ in range(15):
        stopping.drive.command(Controlword.QUICK_STOP)
    assert stopping.is_off() and stopping.told() == [(0x3220, 0x05)]


def test_of_several_faults_in_an_interrupt_the_cause_is_told_rather_than_what_follows(joint):
    """A spring encoder that jumps by a radian trips over-torque and the position limit as well."""
    confused = joint()
    confused.lies[pins.SPRING_ENCODER] = -2.0
    confused.ticks()
    trips = int(confused.drive.firmware.y[signals.Y_TRIPS])
    also = (DriveFault.SPRING_ENCODER, DriveFault.OVER_TORQUE, DriveFault.POSITION_LIMIT)
    assert trips == sum(1 << fault for fault in also)
    assert confused.fault is DriveFault.SPRING_ENCODER and confused.brakes()


def test_a_restored_drive_goes_on_counting_what_may_not_last(joint):
    first, second = joint(), joint()
    first.drive.inputs[pins.ISR_TIMER] = 400
    first.ticks(2)
    second.drive.firmware.restore(first.drive.firmware.snapshot())
    second.drive.counter = first.drive.counter
    second.drive.inputs[:] = first.drive.inputs
    assert second.ticks(30) == 1 and second.fault is DriveFault.TIME_OVERRUN


def test_a_frame_of_another_identifier_is_no_command(bench):
    drive = bench().enable()
    data = nonsense(drive).data
    for _ in range(10):
        drive.tick(Frame(messages.COMMAND + 1, data), drive.frame(ENABLE))
    assert drive.state is DriveState.OPERATION_ENABLED


# --- objects ---------------------------------------------------------------------------------------------------


def test_limits_are_read_and_written_by_sdo_and_hold_at_once(bench):
    drive = bench(watchdog="1s", **GAINS).enable()
    rig = Rig(drive)
    limits = rig.node.sdo["Protection limits"]
    for name in ProtectionConfig.model_fields:
        entry = limits[name.replace("_", " ").capitalize()]
        assert entry.raw == pytest.approx(getattr(drive.config.protection, name), rel=1e-6)
    drive.place(torque=100.0)
    drive.command()
    assert drive.state is DriveState.OPERATION_ENABLED
    limits["Over torque"].raw = 0.6  # of 150 N m
    drive.command()
    assert drive.state is DriveState.FAULT and drive.emergencies[-1][:2] == (0x8311, 0x21)
    drive.firmware.reset()
    assert limits["Over torque"].raw == 1.5  # gone with the power


@pytest.mark.parametrize("value", [-1.0, 0.0, 2e6, math.nan])
def test_a_limit_out_of_range_is_refused_and_changes_nothing(bench, value):
    rig = Rig(bench(**GAINS).boot())
    with pytest.raises(canopen.SdoAbortedError):
        rig.node.sdo["Protection limits"]["Over current"].raw = value
    assert rig.node.sdo["Protection limits"]["Over current"].raw == 1.25


def test_what_is_used_of_the_limits_and_what_has_tripped_is_read_by_sdo(bench):
    drive = bench(watchdog="1s", **GAINS).enable()
    rig = Rig(drive)
    drive.place(torque=45.0)
    drive.inputs[pins.TEMPERATURE_ADC] = 900
    drive.inputs[pins.SUPPLY_ADC] = 4200
    drive.command()
    levels, state = rig.node.sdo["Protection levels"], rig.node.sdo["Protection state"]
    assert levels["Over torque"].raw == pytest.approx(45.0 / 225.0, rel=2e-3)
    assert levels["Over temperature"].raw == pytest.approx(65.0 / 130.0)
    assert levels["Under voltage"].raw == pytest.approx(6.0 / 12.0)
    assert state["Trip word"].raw == state["Fault"].raw == 0
    drive.place(torque=230.0)
    drive.command()
    assert state["Trip word"].raw == 1 << DriveFault.OVER_TORQUE and state["Fault"].raw == DriveFault.OVER_TORQUE
    assert rig.node.sdo[0x603F].raw == 0x8311
