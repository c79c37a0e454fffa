"""Watchdog, faults by limits, quick stop: the state, the code on the bus and what comes out of the power stage.

Monitors that compare sensors with each other, or integrate, are in test_monitors.py.
"""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.drive_faults import EMERGENCIES, DriveFault
from bus.messages import Controlword, Mode, Statusword
from joint_firmware.drive import DriveState
from joint_firmware.protection import REACTIONS
from robots import pins

WATCHDOG_TICKS = 15  # 5 ms at 3 kHz
STOP_TICKS = 1500  # 0.5 s at 3 kHz
ENABLE = Controlword.ENABLE_OPERATION
# codes of CiA 301 and CiA 402 with error registers of CiA 301
WATCHDOG, OVER_TORQUE, POSITION = (0x8130, 0x11), (0x8311, 0x21), (0x8612, 0x21)


def spinning(drive, ticks, frames=(), velocity=1.0):
    """Turn the motor at ``velocity`` [rad/s], joint and spring alike, while ``ticks`` pass."""
    for n in range(ticks):
        drive.inputs[pins.MOTOR_ENCODER] += round(velocity / 3000.0 * drive.joint.sensor.encoder)
        drive.tick(*(frames if n == 0 else ()))


# --- watchdog -----------------------------------------------------------------------------------------------


def test_the_watchdog_trips_on_its_tick_and_not_one_before(bench):
    drive = bench().enable(torque=20.0)
    drive.run(WATCHDOG_TICKS - 1)
    assert drive.state is DriveState.OPERATION_ENABLED and not drive.emergencies
    assert drive.motor_torque == pytest.approx(80.0, abs=drive.resolution)  # (1 + kp) tau_d, spring relaxed
    drive.tick()
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    assert drive.emergencies == [(*WATCHDOG, bytes(5))]
    assert drive.enabled == 1 and drive.motor_torque == 0.0  # at rest, damping asks for nothing
    drive.run(2)
    assert drive.report.error == DriveFault.WATCHDOG
    assert drive.report.statusword & Statusword.MASK == Statusword.QUICK_STOP_ACTIVE


def test_a_command_one_tick_before_the_watchdog_starts_it_anew(bench):
    drive = bench().enable()
    for _ in range(20):
        drive.run(WATCHDOG_TICKS - 1)
        drive.command()
    assert drive.state is DriveState.OPERATION_ENABLED
    drive.run(WATCHDOG_TICKS - 1)
    assert drive.state is DriveState.OPERATION_ENABLED
    drive.tick()
    assert drive.state is DriveState.QUICK_STOP_ACTIVE


@pytest.mark.parametrize(("watchdog", "ticks"), [("1ms", 3), ("20ms", 60), ("0s", 1)])
def test_the_watchdog_time_is_the_configured_one(bench, watchdog, ticks):
    drive = bench(watchdog=watchdog).enable()
    drive.run(ticks - 1)
    assert drive.state is DriveState.OPERATION_ENABLED
    drive.tick()
    assert drive.state is DriveState.QUICK_STOP_ACTIVE


def test_a_watchdog_stop_is_damped_then_ends_in_fault_without_power(bench):
    drive = bench().enable()
    spinning(drive, WATCHDOG_TICKS)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    spinning(drive, 100)
    counts = round(drive.joint.sensor.encoder / 3000.0)
    velocity = counts * 3000.0 / drive.joint.sensor.encoder
    assert drive.motor_torque == pytest.approx(-30.0 * velocity, abs=drive.resolution)
    spinning(drive, STOP_TICKS - 101, velocity=0.0)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE and drive.enabled == 1
    drive.tick()
    assert drive.state is DriveState.FAULT
    spinning(drive, 2)
    assert drive.enabled == 0 and drive.outputs[pins.CURRENT_DEMAND] == 0
    assert drive.report.error == DriveFault.WATCHDOG
    assert len(drive.emergencies) == 1


@pytest.mark.parametrize("counter", ["duplicate", "older"])
def test_repeated_and_old_frames_do_not_feed_the_watchdog(bench, counter):
    drive = bench().enable()
    old = drive.frame(ENABLE, counter=drive.counter - (counter == "older"))
    for _ in range(WATCHDOG_TICKS):
        assert drive.state is DriveState.OPERATION_ENABLED
        drive.tick(old)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE


def test_a_controller_that_comes_back_cannot_enable_before_it_has_reset_the_fault(bench):
    drive = bench().enable()
    drive.run(WATCHDOG_TICKS)
    for _ in range(STOP_TICKS + 10):
        drive.command(torque=20.0)
        assert drive.state in (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT)
        assert drive.motor_torque == 0.0
    assert drive.state is DriveState.FAULT


def test_disabling_a_watchdog_stop_cuts_power_and_keeps_the_cause(bench):
    drive = bench().enable()
    drive.run(WATCHDOG_TICKS + 3)
    drive.command(Controlword.DISABLE_VOLTAGE)
    assert drive.state is DriveState.FAULT and drive.enabled == 0
    drive.run(2)
    assert drive.report.error == DriveFault.WATCHDOG


def test_no_watchdog_runs_in_a_drive_that_is_not_enabled(bench):
    drive = bench().boot()
    drive.command(Controlword.SHUTDOWN)
    drive.command(Controlword.SWITCH_ON)
    drive.run(10 * WATCHDOG_TICKS)
    assert drive.state is DriveState.SWITCHED_ON and not drive.emergencies


# --- faults -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
def test_more_spring_torque_than_allowed_cuts_power_in_the_same_tick(bench, sign):
    drive = bench().enable()
    limit = 225.0  # 1.5 times the torque limit
    drive.place(torque=sign * (limit - 0.1))
    drive.command()
    assert drive.state is DriveState.OPERATION_ENABLED and drive.enabled == 1
    drive.place(torque=sign * (limit + 0.1))
    drive.command()
    assert drive.state is DriveState.FAULT
    assert drive.enabled == 0 and drive.outputs[pins.CURRENT_DEMAND] == 0
    assert drive.emergencies == [(*OVER_TORQUE, bytes(5))]
    drive.run(2)
    assert drive.report.error == DriveFault.OVER_TORQUE
    assert not drive.report.statusword & Statusword.LIMITED  # the law no longer runs


@pytest.mark.parametrize("side", [0, 1])
def test_a_joint_far_beyond_its_limits_cuts_power_in_the_same_tick(bench, side):
    drive = bench().enable()
    outward = (-1, 1)[side]
    edge = drive.joint.limits[side] + outward * 0.2
    drive.place(edge - outward * 1e-3)
    drive.command()
    assert drive.state is DriveState.OPERATION_ENABLED
    drive.place(edge + outward * 1e-3)
    drive.command()
    assert drive.state is DriveState.FAULT
    assert drive.enabled == 0 and drive.outputs[pins.CURRENT_DEMAND] == 0
    assert drive.emergencies == [(*POSITION, bytes(5))]


def test_the_cause_of_a_fault_is_reported_once_and_kept(bench):
    drive = bench().enable()
    drive.place(torque=300.0)
    for _ in range(3 * STOP_TICKS):
        drive.command()
    assert drive.state is DriveState.FAULT and drive.emergencies == [(*OVER_TORQUE, bytes(5))]


def test_a_fault_reset_is_an_edge_and_is_told_on_the_bus(bench):
    drive = bench().enable()
    drive.place(torque=300.0)
    drive.command(ENABLE | Controlword.FAULT_RESET)  # the bit is there already when the fault comes
    assert drive.state is DriveState.FAULT
    drive.place()
    for _ in range(5):
        drive.command(Controlword.FAULT_RESET)
    assert drive.state is DriveState.FAULT
    drive.command(Controlword.DISABLE_VOLTAGE)
    assert drive.state is DriveState.FAULT
    drive.emergencies.clear()
    drive.command(Controlword.FAULT_RESET)
    assert drive.state is DriveState.SWITCH_ON_DISABLED and drive.enabled == 0
    assert drive.emergencies == [(0x0000, 0x00, bytes(5))]
    drive.run(2)
    assert drive.report.error == 0


def test_a_fault_cannot_be_reset_while_its_cause_is_there(bench):
    drive = bench().enable()
    drive.place(torque=300.0)
    drive.command()
    for word in (0, Controlword.FAULT_RESET, 0, Controlword.FAULT_RESET, Controlword.SHUTDOWN):
        drive.command(word)
        assert drive.state is DriveState.FAULT and drive.enabled == 0
    assert drive.emergencies == [(*OVER_TORQUE, bytes(5))]
    drive.place(torque=0.0)
    drive.command(0)
    for word in (Controlword.FAULT_RESET, Controlword.SHUTDOWN, Controlword.SWITCH_ON, ENABLE):
        drive.command(word, torque=10.0)
    assert drive.state is DriveState.OPERATION_ENABLED and drive.motor_torque > 0
    assert [code for code, *_ in drive.emergencies] == [OVER_TORQUE[0], 0]


def test_what_is_wrong_before_a_drive_has_power_shows_in_the_tick_that_enables_it(bench):
    drive = bench().boot()
    drive.place(torque=300.0)
    for word in (Controlword.SHUTDOWN, Controlword.SWITCH_ON):
        drive.command(word)
    assert drive.state is DriveState.SWITCHED_ON and not drive.emergencies
    drive.command(ENABLE, torque=10.0)
    assert drive.state is DriveState.FAULT and drive.enabled == 0
    assert drive.emergencies == [(*OVER_TORQUE, bytes(5))]


def test_every_fault_has_a_reaction_and_a_code_of_its_own():
    faults = set(DriveFault) - {DriveFault.NONE}
    assert set(REACTIONS) == faults and set(EMERGENCIES) == set(DriveFault)
    codes = [EMERGENCIES[fault].code for fault in faults]
    assert len(set(codes)) == len(codes)


def test_error_registers_follow_from_the_classes_of_the_codes():
    """CiA 301: 2xxx current, 3xxx voltage, 4xxx temperature, 81xx communication; the profile's other classes bit 5."""
    classes = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08}
    for fault, emergency in EMERGENCIES.items():
        if fault in (DriveFault.NONE, DriveFault.CURRENT_SENSOR, DriveFault.TIME_OVERRUN):
            continue  # of a class that CiA 301 gives no bit: measurement of the current, the maker's software
        expected = 0x10 if emergency.code >> 8 == 0x81 else classes.get(emergency.code >> 12, 0x20)
        assert emergency.registers == 0x01 | expected, fault


# --- quick stop ---------------------------------------------------------------------------------------------


def test_a_commanded_quick_stop_damps_then_switches_off_without_fault(bench):
    drive = bench().enable(torque=50.0)
    drive.command(Controlword.QUICK_STOP, torque=50.0)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    assert drive.motor_torque == 0.0 and drive.enabled == 1
    drive.run(STOP_TICKS - 1)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    drive.tick()
    assert drive.state is DriveState.SWITCH_ON_DISABLED and drive.enabled == 0
    drive.run(2)
    assert drive.report.error == 0 and not drive.emergencies


def test_repeating_a_quick_stop_does_not_prolong_it(bench):
    drive = bench().enable()
    drive.command(Controlword.QUICK_STOP)
    for _ in range(STOP_TICKS):
        assert drive.state is DriveState.QUICK_STOP_ACTIVE
        drive.command(Controlword.QUICK_STOP)
    assert drive.state is DriveState.SWITCH_ON_DISABLED


def test_a_commanded_quick_stop_after_a_reset_watchdog_is_no_fault(bench):
    drive = bench().enable()
    drive.run(WATCHDOG_TICKS)
    for word in (0, 0x80, Controlword.SHUTDOWN, Controlword.SWITCH_ON, ENABLE, Controlword.QUICK_STOP):
        drive.command(word)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    drive.run(STOP_TICKS)
    assert drive.state is DriveState.SWITCH_ON_DISABLED and drive.report.error == 0


def test_damping_mode_brakes_by_motor_velocity_and_ignores_the_torque(bench):
    drive = bench().enable()
    for _ in range(100):
        spinning(drive, 1, [drive.frame(ENABLE, Mode.DAMPING, torque=50.0)], velocity=-2.0)
    assert drive.motor_torque == pytest.approx(60.0, rel=1e-2)


MODES = {value for name, value in vars(Mode).items() if name.isupper()}


@given(st.integers(-128, 127).filter(lambda mode: mode not in MODES))
def test_an_unknown_mode_asks_for_no_torque(bench, mode):
    drive = bench().enable()
    for _ in range(4):
        spinning(drive, 10, [drive.frame(ENABLE, mode, torque=50.0, position=1.0)])
    assert drive.enabled == 1 and drive.motor_torque == 0.0


@given(st.sampled_from([0, Controlword.SHUTDOWN, Controlword.SWITCH_ON]))
def test_a_drive_that_is_not_enabled_has_no_power(bench, word):
    drive = bench().enable(torque=50.0)
    drive.command(word, torque=50.0)
    assert drive.enabled == 0 and drive.outputs[pins.CURRENT_DEMAND] == 0
