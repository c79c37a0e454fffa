"""The firmware node: start-up, reports, commands good and bad, snapshots, compiled and interpreted law."""

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bus import messages
from bus.frames import Frame
from bus.messages import Controlword, GainSet, Mode, Setpoint, Statusword
from hil.compiled import compile_function
from joint_firmware.drive import DriveState
from joint_firmware.laws import DriveLaw
from joint_firmware.laws import signals as law
from robots import pins

ENABLE = Controlword.ENABLE_OPERATION
MODES = [number for name, number in vars(Mode).items() if name.isupper()]
JOINTS = ["right_abduction", "right_hip", "right_knee", "left_abduction", "left_hip", "left_knee"]
int32 = st.integers(-(2**31), 2**31 - 1)


# --- start-up -----------------------------------------------------------------------------------------------


def test_a_drive_boots_on_its_tick_and_without_power(bench):
    drive = bench()
    for _ in range(60):  # 20 ms at 3 kHz
        drive.tick(drive.frame(ENABLE))
        assert drive.state is DriveState.NOT_READY
        assert list(drive.outputs) == [0, 0]
    drive.tick()
    assert drive.state is DriveState.SWITCH_ON_DISABLED


def test_the_start_up_sequence_is_that_of_cia_402(bench):
    drive = bench().boot()
    steps = [
        (Controlword.SHUTDOWN, DriveState.READY_TO_SWITCH_ON, 0),
        (Controlword.SWITCH_ON, DriveState.SWITCHED_ON, 0),
        (ENABLE, DriveState.OPERATION_ENABLED, 1),
    ]
    for word, state, enabled in steps:
        drive.command(word, torque=10.0)
        assert (drive.state, drive.enabled) == (state, enabled)
        drive.run(2)
        assert drive.report.statusword & Statusword.MASK == state
    drive.command(torque=10.0)
    assert drive.motor_torque > 0


def test_enabling_at_once_leads_nowhere_from_disabled_and_by_steps_from_ready(bench):
    drive = bench().boot()
    for _ in range(5):
        drive.command(ENABLE)
        assert drive.state is DriveState.SWITCH_ON_DISABLED
    drive.command(Controlword.SHUTDOWN)
    drive.command(ENABLE)
    assert drive.state is DriveState.SWITCHED_ON and drive.enabled == 0
    drive.command(ENABLE)
    assert drive.state is DriveState.OPERATION_ENABLED


# --- reports and heartbeats ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "report_rate"), [("3kHz", "1.5kHz"), ("3kHz", "3kHz"), ("4kHz", "1kHz")])
def test_reports_come_at_their_rate_and_heartbeats_in_their_period(bench, rate, report_rate):
    drive = bench(rate=rate, report_rate=report_rate)
    reports, heartbeats = [], []
    per_report = int(drive.config.rate / drive.config.report_rate)
    for tick in range(int(drive.config.rate)):
        for frame in drive.tick():
            assert frame.fd and frame.brs and not frame.extended
            if frame.id == messages.STATE + 2:
                reports.append((tick, messages.decode_state(frame.data).counter))
            else:
                assert frame.id == messages.HEARTBEAT + 2
                heartbeats.append((tick, frame.data))
    boot = int(0.02 * drive.config.rate)
    assert heartbeats.pop(0) == (boot, b"\x00")  # the boot-up message; nothing is sent before it
    first = boot // per_report + 1
    assert reports == [(n * per_report, n) for n in range(first, int(drive.config.report_rate))]
    assert len(heartbeats) in (9, 10)
    period = int(0.1 * drive.config.rate)
    assert {b[0] - a[0] for a, b in pairwise(heartbeats)} == {period} and heartbeats[0][0] - boot <= period
    assert {data for _, data in heartbeats} == {b"\x05"}  # operational, without a master
    if per_report > 1:
        assert not {tick for tick, _ in heartbeats} & {tick for tick, _ in reports}


def test_the_heartbeats_of_a_robot_do_not_meet(bench):
    seen = []
    for joint in JOINTS:
        drive = bench(joint).boot()
        for tick in range(300):
            seen += [tick for frame in drive.tick() if frame.id > messages.HEARTBEAT]
    assert len(seen) == len(set(seen)) == len(JOINTS)


def test_a_report_rate_that_does_not_divide_the_rate_is_refused(bench):
    for rate in ("1.4kHz", "6kHz"):
        with pytest.raises(ValueError, match=r"rate \(3000 Hz\) must be a multiple of report_rate"):
            bench(report_rate=rate)


def test_the_report_counter_wraps_at_2_to_the_16(bench):
    drive = bench(compile=compile_function, report_rate="3kHz")
    drive.run(0xFFFF)
    for expected in (0xFFFF, 0, 1):
        drive.tick()
        assert drive.report.counter == expected


def test_a_report_is_what_the_codec_of_the_messages_makes_of_it(bench):
    drive = bench("left_hip").enable(torque=5.0)
    drive.place(0.3, 12.0)
    drive.inputs[pins.CURRENT_ADC] = -321
    drive.inputs[pins.TEMPERATURE_ADC] = 457
    drive.inputs[pins.SWITCHES] = pins.FOOT_SWITCH
    for _ in range(200):
        drive.command(torque=5.0)
    state = drive.report
    assert state.position == pytest.approx(0.3, abs=1e-3) and state.torque == pytest.approx(12.0, abs=0.03)
    assert (state.current, state.temperature, state.error) == (pytest.approx(-3.21), 45, 0)
    assert abs(state.velocity) < 1e-5 and state.motor_velocity == 0.0
    assert state.command_counter in (drive.counter, drive.counter - 1)
    assert state.statusword == Statusword.OPERATION_ENABLED | Statusword.FOOT_CONTACT
    (sent,) = (drive.tick() + drive.tick())[:1]
    assert messages.encode_state(messages.decode_state(sent.data)) == sent.data


@pytest.mark.parametrize(("adc", "temperature"), [(-1, 0), (2560, 255), (2**31 - 1, 255)])
def test_temperatures_saturate(bench, adc, temperature):
    drive = bench().boot()
    drive.inputs[pins.TEMPERATURE_ADC] = adc
    drive.run(2)
    assert drive.report.temperature == temperature


def test_an_active_limit_is_told(bench):
    drive = bench().enable()
    for torque, limited in ((10.0, False), (200.0, True), (10.0, False)):
        for _ in range(60):
            drive.command(torque=torque, torque_limit=60.0)
        assert bool(drive.report.statusword & Statusword.LIMITED) is limited


# --- commands -----------------------------------------------------------------------------------------------


def torque_in_force(drive):
    """The commanded torque that a drive follows, read from what it asks of its motor."""
    return drive.motor_torque / (1.0 + drive.config.stance.kp)  # (1 + kp) tau_d on a relaxed spring


@pytest.mark.parametrize("start", [1, 0x7FFF, 0xFFFE])
def test_stale_duplicate_and_reordered_commands_are_ignored_also_across_the_wrap(bench, start):
    drive = bench()
    drive.counter = start - 4 & 0xFFFF
    drive.enable(torque=1.0)
    assert drive.counter == start - 1 & 0xFFFF
    sequence = [(start, 1.5, 1.5), (start, 3.0, 1.5), (start + 2, 2.0, 2.0), (start + 1, 3.0, 2.0),
                (start + 2, 3.0, 2.0), (start + 3, 2.5, 2.5), (start + 3 + 0x8000, 3.0, 2.5)]  # fmt: skip
    for counter, sent, expected in sequence:
        drive.tick(drive.frame(ENABLE, counter=counter & 0xFFFF, torque=sent))
        drive.tick()
        assert torque_in_force(drive) == pytest.approx(expected, abs=drive.resolution), f"after {counter:#x}"
        drive.tick()
        assert messages.newer(drive.report.command_counter + 1, drive.counter)
    drive.tick(drive.frame(ENABLE, counter=start + 5 & 0xFFFF, torque=1.0),
               drive.frame(ENABLE, counter=start + 4 & 0xFFFF, torque=3.0))  # fmt: skip
    assert torque_in_force(drive) == pytest.approx(1.0, abs=drive.resolution)  # the newest of a tick counts


def test_stale_controlwords_do_not_switch(bench):
    drive = bench().enable()
    drive.tick(drive.frame(Controlword.DISABLE_VOLTAGE, counter=drive.counter - 1))
    drive.tick(drive.frame(Controlword.QUICK_STOP, counter=drive.counter))
    assert drive.state is DriveState.OPERATION_ENABLED


def test_a_controller_that_counts_anew_is_heard_after_a_silence_unless_the_drive_is_enabled(bench):
    drive = bench()
    drive.counter = 30_000
    drive.enable()
    drive.counter = 0
    for _ in range(14):
        drive.command(Controlword.DISABLE_VOLTAGE)
        assert drive.state is DriveState.OPERATION_ENABLED
    drive.command(Controlword.DISABLE_VOLTAGE)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE  # the watchdog saw nothing new in force
    for word in (Controlword.DISABLE_VOLTAGE, Controlword.FAULT_RESET, Controlword.SHUTDOWN):
        drive.command(word)
    assert drive.state is DriveState.READY_TO_SWITCH_ON
    drive.run(2)
    assert drive.report.command_counter == drive.counter < 30


@given(st.binary(max_size=64).filter(lambda data: len(data) != messages.COMMAND_LENGTH))
def test_commands_of_a_wrong_length_are_counted_and_ignored(bench, data):
    drive = bench().enable(torque=5.0)
    drive.tick(Frame(messages.COMMAND, data))
    assert drive.firmware.malformed == 1
    drive.run(3)  # switched on, the demand runs to its place
    assert drive.state is DriveState.OPERATION_ENABLED
    assert torque_in_force(drive) == pytest.approx(5.0, abs=drive.resolution)
    drive.run(14)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE  # they do not feed the watchdog either


@pytest.mark.parametrize(
    "change",
    [{"id": 0x201}, {"id": 0x182}, {"id": 0x603}, {"extended": True}, {"id": 0x000, "extended": True},
     {"id": 0x10000200, "extended": True}],
)  # fmt: skip
def test_frames_for_others_are_ignored(bench, change):
    drive = bench().enable(torque=5.0)
    drive.tick(drive.frame(Controlword.DISABLE_VOLTAGE)._replace(**change))
    assert drive.state is DriveState.OPERATION_ENABLED and drive.firmware.malformed == 0


@pytest.mark.parametrize("joint", JOINTS)
def test_a_drive_reads_its_own_slot(bench, joint):
    drive = bench(joint).enable()
    torques = (2.0, 4.0, 6.0)
    slots = [Setpoint(ENABLE, Mode.TORQUE, torque=torque) for torque in torques]
    drive.tick(Frame(messages.COMMAND, messages.encode_command(drive.counter + 1, slots)))
    expected = torques[JOINTS.index(joint) % 3]
    assert torque_in_force(drive) == pytest.approx(expected, abs=drive.resolution)


def test_the_gain_set_is_switched_by_command_and_without_a_bump(bench):
    """Stance has kp 3 and no integral, swing kp 4 and ki 20 1/s."""
    drive = bench().enable()

    def demand(gain_set, ticks=1):
        for _ in range(ticks):
            drive.command(torque=14.0, gain_set=gain_set)
        return drive.motor_torque

    drive.place(torque=10.0)
    stance = demand(GainSet.STANCE, 60)  # until the motor's velocity has passed the filter
    assert stance == pytest.approx(14.0 + 3.0 * 4.0, abs=0.1)
    assert demand(GainSet.SWING) == stance
    grown = demand(GainSet.SWING, 300) - stance
    assert grown == pytest.approx(20.0 * 4.0 * 0.1 + (4.0 - 3.0) * 4.0, abs=0.2)  # the integral; kp's share, faded in
    drive.place(torque=9.0)  # one newton metre more of error meets the new proportional gain
    swing = demand(GainSet.SWING, 60)
    assert swing - stance - grown == pytest.approx(4.0 + 20.0 * 5.0 * 0.02, abs=0.4)
    assert demand(200) == pytest.approx(swing, abs=2 * drive.resolution)  # an unknown set is stance
    assert demand(200, 30) == pytest.approx(29.0 + (swing - 29.0) * np.exp(-1.0), abs=0.4)
    assert demand(200, 300) == pytest.approx(29.0, abs=0.1)


def test_position_mode_follows_position_and_velocity(bench):
    drive = bench().enable(Mode.POSITION)
    for _ in range(30):
        drive.command(mode=Mode.POSITION, position=0.1, velocity=-0.5, torque=3.0)
    expected = 300.0 * 0.1 - 10.0 * 0.5 + 3.0
    assert torque_in_force(drive) == pytest.approx(expected, abs=drive.resolution)


# --- whatever comes -----------------------------------------------------------------------------------------


payloads = st.one_of(
    st.binary(min_size=64, max_size=64),
    st.builds(
        lambda words, counter, mode, torque: messages.encode_command(
            counter, [Setpoint(words, mode, torque=torque, position=torque, velocity=torque)] * 3
        ),
        st.sampled_from([0, 2, 6, 7, 15, 128]), st.integers(0, 0xFFFF),
        st.sampled_from(MODES), st.floats(-1e5, 1e5),
    ),
)  # fmt: skip
inputs = st.lists(int32, min_size=pins.N_INPUTS, max_size=pins.N_INPUTS)


@given(st.lists(st.tuples(inputs, payloads), min_size=1, max_size=12))
@example([([2**31 - 1] * pins.N_INPUTS, bytes(64)), ([-(2**31)] * pins.N_INPUTS, bytes(64))])
def test_no_command_and_no_sensor_can_crash_a_drive_or_exceed_its_current(bench, steps):
    drive = bench().enable()
    bound = drive.joint.actuator.current_limit / pins.AMPERE_PER_COUNT
    for values, payload in steps:
        drive.inputs[:] = values
        drive.tick(Frame(messages.COMMAND, payload))
        drive.tick()
        current, enabled = drive.outputs
        assert abs(current) <= bound and enabled in (0, 1)
        assert enabled or current == 0
        assert len(messages.encode_state(drive.report)) == messages.STATE_LENGTH


def random_life(seed, ticks):
    """Pins and frames of a drive that is switched on, commanded, starved, reset: a function of the seed."""
    rng = np.random.default_rng(seed)
    theta, word, counter, life = 0.0, 0, 0, []
    sequence = [Controlword.SHUTDOWN, Controlword.SWITCH_ON, *12 * [ENABLE], Controlword.QUICK_STOP, 0, 0x80]
    for tick in range(ticks):
        frames = []
        if rng.random() < (0.6 if tick % 80 < 60 else 0.0):
            word = (word + (rng.random() < 0.3)) % len(sequence)
            counter += rng.choice([0, 1, 1, 1, 2])
            setpoint = Setpoint(
                sequence[word], int(rng.choice(MODES)),
                int(rng.integers(2)), 20.0 * rng.normal(), rng.normal(), rng.normal(), 60.0,
            )  # fmt: skip
            frames.append(Frame(messages.COMMAND, messages.encode_command(counter, [setpoint] * 3)))
        theta += rng.integers(-40, 41)
        sensed = [theta, rng.integers(-200, 200), rng.integers(-2750, 2750), 250, 4800, rng.integers(2)]
        life.append((sensed, frames))
    return life


def live(drive, life):
    """What a drive does in ``life``: pins and frames of every tick."""
    record = []
    for sensed, frames in life:
        drive.inputs[: len(sensed)] = sensed
        sent = drive.firmware.tick(0, frames)
        record.append((tuple(drive.outputs), tuple(sent), drive.state))
    return record


def test_a_random_life_visits_every_state(bench):
    drive = bench(boot_time="2ms", quick_stop_time="5ms")
    states = {state for _, _, state in live(drive, random_life(1, 1500))}
    assert states == set(DriveState) - {DriveState.FAULT_REACTION_ACTIVE}


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(0, 400))
def test_a_restored_drive_goes_on_byte_for_byte(bench, seed, at):
    config = {"boot_time": "2ms", "quick_stop_time": "5ms"}
    life = random_life(seed, 400)
    first = bench(**config)
    live(first, life[:at])
    snapshot = first.firmware.snapshot()
    rest = live(first, life[at:])
    another = bench(**config)
    live(another, random_life(seed + 1, 50))
    another.firmware.restore(snapshot)
    assert live(another, life[at:]) == rest
    first.firmware.restore(snapshot)  # the snapshot is still what it was, also after use
    assert live(first, life[at:]) == rest
    assert first.firmware.malformed == another.firmware.malformed


def test_a_restored_drive_remembers_that_the_reset_bit_was_set(bench):
    drive = bench().enable()
    drive.place(torque=300.0)
    drive.command(ENABLE | Controlword.FAULT_RESET)
    another = bench()
    another.firmware.restore(drive.firmware.snapshot())
    another.counter = drive.counter
    reset = DriveState.SWITCH_ON_DISABLED
    for word, state in ((0x80, DriveState.FAULT), (0, DriveState.FAULT), (0x80, reset)):
        another.command(word)
        assert another.state is state


# --- compiled and interpreted -------------------------------------------------------------------------------


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_compiled_and_interpreted_drives_are_equal_to_the_bit(bench, seed):
    life = random_life(seed, 200)
    drives = [bench(boot_time="2ms", compile=compile) for compile in (lambda f: f, compile_function)]
    records = [live(drive, life) for drive in drives]
    assert records[0] == records[1]
    states = [drive.firmware.snapshot() for drive in drives]
    for name in ("x", "u", "y"):
        assert states[0][name].tobytes() == states[1][name].tobytes()


def test_the_compiled_law_is_equal_to_the_bit_on_random_numbers():
    function = DriveLaw("PID_m").function
    interpreted, compiled = function, compile_function(function)
    rng = np.random.default_rng(7)
    for scale in (1e-3, 1.0, 1e3, 1e9):
        for _ in range(200):
            arguments = [scale * rng.normal(size=interpreted.size1_in(i)) for i in range(4)]
            for ours, theirs in zip(interpreted(*arguments), compiled(*arguments), strict=True):
                assert np.array(ours).tobytes() == np.array(theirs).tobytes()


def test_gains_of_one_joint_are_those_of_its_drive_and_of_its_dictionary(bench):
    changed = {"joints": {"left_hip": {"swing": {"kp": 7.5}}}}
    left, right = (bench(f"{side}_hip", **changed) for side in ("left", "right"))
    swing = left.config.swing
    for drive, kp in ((left, 7.5), (right, swing.kp)):
        drive.enable(gain_set=GainSet.SWING)
        u = drive.firmware.u
        assert (u[law.U_KP], u[law.U_KI], u[law.U_KD]) == (kp, swing.ki, swing.kd)
        assert drive.firmware.dictionary.read(0x2001, 1) == struct.pack("<f", kp)
