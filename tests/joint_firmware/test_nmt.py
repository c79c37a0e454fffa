"""A drive as a node of a CANopen network, seen by a stock master: NMT, heartbeat, SYNC, emergencies, CiA 402 by SDO."""

from itertools import pairwise

import canopen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus import messages
from bus.drive_faults import DriveFault
from bus.frames import Frame
from bus.messages import Controlword, GainSet, Mode
from joint_firmware.drive import POWERED, DriveState
from robots import pins

from .canopen_rig import GAINS, Rig
from .test_protection import spinning

ENABLE = Controlword.ENABLE_OPERATION
WATCHDOG_TICKS, STOP_TICKS, BOOT_TICKS = 15, 1500, 60  # 5 ms, 0.5 s, 20 ms at 3 kHz


@pytest.fixture
def rig(bench):
    return Rig(bench(**GAINS).boot())


def identifiers(frames):
    return [frame.id for frame in frames]


def states(frames):
    """What the heartbeats among ``frames`` tell."""
    return [frame.data[0] for frame in frames if frame.id == messages.HEARTBEAT + 2]


# --- NMT ----------------------------------------------------------------------------------------------------


def test_a_node_is_silent_and_deaf_until_its_boot_up_message(bench):
    rig = Rig(bench())
    for _ in range(BOOT_TICKS):
        frames = [rig.bench.frame(ENABLE), Frame(0x000, b"\x02\x00"), Frame(0x602, b"\x40\x00\x10\x00" + bytes(4))]
        assert rig.run(1, *frames) == []
    assert rig.run(1) == [Frame(0x702, b"\0")]
    assert identifiers(rig.run(2))[-1] == 0x182  # operational without a master
    assert rig.node.nmt.state == "PRE-OPERATIONAL"  # as far as a boot-up message tells
    rig.run(300)
    assert rig.node.nmt.state == "OPERATIONAL"


def test_the_state_is_sent_in_operational_alone_and_the_heartbeat_tells_the_state(rig):
    for order, value, reports in (("PRE-OPERATIONAL", 0x7F, 0), ("OPERATIONAL", 5, 150), ("STOPPED", 4, 0)):
        rig.node.nmt.state = order
        sent = rig.run(300)
        assert states(sent) == [value]
        assert identifiers(sent).count(0x182) in (reports, reports - 1 if reports else 0)
        assert rig.node.nmt.state == order


@pytest.mark.parametrize("address", [0, 2])
def test_a_stop_brakes_an_enabled_drive_as_a_lost_master_does(bench, address):
    drive = bench().enable(torque=20.0)
    rig = Rig(drive)
    spinning(drive, 60)
    for _ in range(3):
        drive.command(torque=20.0)
    spinning(drive, 60, [drive.frame(ENABLE, torque=20.0), Frame(0x000, bytes([2, address]))])
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    assert drive.emergencies == [(0x8130, 0x11, bytes(5))]
    velocity = round(drive.joint.sensor.encoder / 3000.0) * 3000.0 / drive.joint.sensor.encoder
    assert drive.motor_torque == pytest.approx(-30.0 * velocity, abs=drive.resolution)  # 30 N m s/rad
    for _ in range(STOP_TICKS):
        drive.command(torque=20.0)  # not heard
    assert drive.state is DriveState.FAULT and drive.enabled == 0
    rig.node.nmt.state = "OPERATIONAL"
    for word, state in ((0x80, DriveState.SWITCH_ON_DISABLED), (6, DriveState.READY_TO_SWITCH_ON)):
        drive.command(word)
        assert drive.state is state


def test_a_stop_for_another_node_or_of_a_wrong_form_is_not_for_this_one(bench):
    drive = bench().enable()
    for data in (b"\x02\x03", b"\x02", b"\x02\x02\x00", b"\x07\x02", b""):
        drive.tick(drive.frame(ENABLE), Frame(0x000, data))
        drive.tick(drive.frame(ENABLE), Frame(0x000, b"\x02\x02", extended=True))
    assert drive.state is DriveState.OPERATION_ENABLED and drive.firmware.malformed == 3


def test_in_pre_operational_commands_are_not_heard_and_the_watchdog_acts(rig):
    drive = rig.bench.enable()
    rig.node.nmt.state = "PRE-OPERATIONAL"
    for _ in range(WATCHDOG_TICKS):
        drive.command()
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    assert rig.node.sdo[0x6041].raw & 0x6F == 0x07  # SDOs are


def test_a_stopped_node_answers_no_sdo(rig):
    rig.node.nmt.state = "STOPPED"
    assert rig.raw(b"\x40\x00\x10\x00" + bytes(4)) == []
    rig.node.nmt.state = "PRE-OPERATIONAL"
    assert rig.node.sdo[0x1000].raw == 0x00020192


def test_a_reset_of_the_node_restores_everything_and_cuts_power(bench):
    drive = bench(**GAINS).enable(torque=20.0)
    rig = Rig(drive)
    rig.node.sdo[0x2000]["kp"].raw = 3.0
    rig.node.sdo[0x607D][2].phys = 0.5
    rig.node.sdo[0x1017].raw = 10
    drive.command(torque=20.0)
    fresh = bench(**GAINS).boot().firmware.snapshot()
    rig.node.nmt.state = "RESET"
    assert drive.state is DriveState.NOT_READY and (drive.enabled, drive.motor_torque) == (0, 0.0)
    sent = rig.run(BOOT_TICKS)
    assert identifiers(sent) == [0x702] and drive.state is DriveState.SWITCH_ON_DISABLED
    assert rig.node.sdo[0x2000]["kp"].raw == 1.0 and rig.node.sdo[0x1017].raw == 100
    assert drive.firmware.snapshot()["settings"] == fresh["settings"]
    drive.counter = 7  # a controller that starts anew is heard at once
    drive.enable()


def test_a_reset_of_communication_keeps_gains_and_stops_an_enabled_drive(rig):
    drive = rig.bench.enable()
    rig.node.sdo[0x2000]["kp"].raw = 3.0
    rig.node.sdo[0x1017].raw = 10
    rig.node.sdo[0x1800][2].raw = 1
    rig.network.seen.clear()
    rig.node.nmt.state = "RESET COMMUNICATION"
    assert identifiers(rig.network.seen) == [0x82, 0x702]  # says why, then boots
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    assert 0x182 in identifiers(rig.run(2))
    assert (rig.node.sdo[0x1017].raw, rig.node.sdo[0x1800][2].raw) == (100, 255)
    assert rig.node.sdo[0x2000]["kp"].raw == 3.0


@pytest.mark.parametrize(("milliseconds", "ticks"), [(10, 30), (1000, 3000), (1, 4)])
def test_the_heartbeat_period_is_the_written_one_to_a_report_period(rig, milliseconds, ticks):
    rig.node.sdo[0x1017].raw = milliseconds
    beats = [n for n in range(4 * ticks) if 0x702 in identifiers(rig.run(1))]
    assert len(beats) == 4 and {b - a for a, b in pairwise(beats)} == {ticks}
    rig.node.sdo[0x1017].raw = 0
    assert 0x702 not in identifiers(rig.run(5000))


# --- whatever comes -----------------------------------------------------------------------------------------

services = st.builds(
    lambda identifier, data, extended, remote: Frame(identifier, data, False, False, extended, remote),
    st.sampled_from([0x000, 0x000, 0x080, 0x081, 0x182, 0x200, 0x602, 0x702]),
    st.one_of(st.binary(max_size=8), st.builds(lambda c, n: bytes([c, n]), st.sampled_from([1, 2, 128, 129, 130, 7]),
                                               st.sampled_from([0, 2, 3]))),
    st.sampled_from([False, False, False, True]), st.sampled_from([False, False, False, True]),
)  # fmt: skip


@given(st.lists(st.tuples(services, st.integers(1, 400)), min_size=1, max_size=12), st.integers(0, 12))
def test_no_service_frame_breaks_a_drive_and_a_restored_one_goes_on_as_it_did(bench, life, at):
    first, another = Rig(bench(quick_stop_time="30ms").enable()), Rig(bench(quick_stop_time="30ms"))
    snapshot = None
    rest = []
    for n, (frame, ticks) in enumerate(life):
        if n == at:
            snapshot = first.bench.firmware.snapshot()
        sent = first.run(ticks, frame)
        assert first.bench.enabled == 0 or first.bench.state in POWERED
        for answer in sent:
            assert answer.id in (0x182, 0x082, 0x582, 0x702)
        if n >= at:
            rest.append(sent)
    if snapshot is not None:
        another.bench.firmware.restore(snapshot)
        another.bench.inputs[:] = first.bench.inputs
        assert [another.run(ticks, frame) for frame, ticks in life[at:]] == rest
        assert another.bench.firmware.malformed == first.bench.firmware.malformed


# --- SYNC ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "per_report"), [(0, 1), (1, 1), (3, 3), (240, 240)])
def test_a_synchronous_state_is_sent_with_every_nth_sync_and_holds_that_ticks_sample(rig, kind, per_report):
    rig.node.sdo[0x1800][2].raw = kind
    assert 0x182 not in identifiers(rig.run(100))
    for n in range(1, 2 * per_report + 1):
        rig.bench.place(0.001 * n)
        rig.network.seen.clear()
        rig.network.sync.transmit()
        reports = [f for f in rig.network.seen if f.id == 0x182]
        assert len(reports) == (n % per_report == 0)
        if reports:
            assert messages.decode_state(reports[0].data).position == pytest.approx(0.001 * n, abs=1e-4)
    rig.node.sdo[0x1800][2].raw = 255
    assert identifiers(rig.run(100)).count(0x182) == 50


def test_a_flood_of_syncs_is_one_report_a_tick_and_none_with_a_counter_is_taken(rig):
    rig.node.sdo[0x1800][2].raw = 1
    assert identifiers(rig.run(1, *[Frame(0x080, b"", False, False)] * 50)) == [0x182]
    assert identifiers(rig.run(1, Frame(0x080, b"\x01", False, False))) == []
    assert rig.bench.firmware.malformed == 1
    stop = Frame(0x000, b"\x80\x02", False, False)
    assert identifiers(rig.run(1, Frame(0x080, b"", False, False), stop)) == []
    assert identifiers(rig.run(1, Frame(0x080, b"", False, False))) == []


# --- emergencies --------------------------------------------------------------------------------------------


def test_a_fault_is_told_and_kept_in_the_history(rig):
    drive, sdo = rig.bench.enable(), rig.node.sdo
    drive.place(torque=300.0)
    rig.run(1)
    assert rig.emergencies() == [(0x8311, 0x21)]
    assert rig.node.emcy.log[0].get_desc() == "Monitoring"
    assert (sdo[0x603F].raw, sdo[0x1001].raw, sdo[0x1003][0].raw, sdo[0x1003][1].raw) == (0x8311, 0x21, 1, 0x8311)
    drive.place()
    rig.run(1)
    rig.run(3, drive.frame(Controlword.FAULT_RESET))
    assert rig.emergencies() == [(0x8311, 0x21), (0x0000, 0x00)] and rig.node.emcy.active == []
    assert (sdo[0x603F].raw, sdo[0x1001].raw, sdo[0x1003][0].raw) == (0, 0, 1)
    drive.enable()
    rig.run(WATCHDOG_TICKS)
    assert [sdo[0x1003][n].raw for n in range(3)] == [2, 0x8130, 0x8311]  # the newest first
    sdo[0x1003][0].raw = 0
    assert sdo[0x1003][0].raw == 0
    with pytest.raises(canopen.SdoAbortedError) as caught:
        sdo[0x1003][1].raw  # noqa: B018
    assert caught.value.code == 0x08000024


def test_the_history_holds_eight_errors(rig):
    drive = rig.bench
    for _ in range(11):
        drive.command(Controlword.DISABLE_VOLTAGE)
        drive.command(Controlword.FAULT_RESET)
        for word in (Controlword.SHUTDOWN, Controlword.SWITCH_ON, ENABLE):
            drive.command(word)
        drive.place(torque=300.0)
        drive.tick()
        drive.place()
    assert rig.node.sdo[0x1003][0].raw == 8


def test_an_error_of_a_stopped_node_is_told_once_it_may_speak(rig):
    drive = rig.bench.enable()
    rig.node.nmt.state = "STOPPED"
    rig.run(STOP_TICKS + 1)
    assert rig.emergencies() == [(0x8130, 0x11)]  # the last word before it fell silent
    sent = []
    drive.firmware._power_off(DriveFault.POSITION_LIMIT, sent)  # in the stopped state, whatever its cause
    assert sent == []
    rig.node.nmt.state = "PRE-OPERATIONAL"
    assert rig.emergencies()[1:] == [(0x8612, 0x21)]


# --- CiA 402 by SDO -----------------------------------------------------------------------------------------


def walk(rig, mode=Mode.TORQUE):
    """Enable by SDO alone."""
    rig.node.sdo[0x6060].raw = mode
    for word, status in ((6, 0x21), (7, 0x23), (15, 0x27)):
        rig.node.sdo[0x6040].raw = word
        assert rig.node.sdo[0x6041].raw & 0x6F == status
    assert rig.node.sdo[0x6061].raw == mode


def refused(rig, index, value):
    with pytest.raises(canopen.SdoAbortedError) as caught:
        rig.node.sdo[index].raw = value
    return caught.value.code


def test_a_master_enables_a_drive_and_commands_torque_by_sdo_alone(rig):
    walk(rig)
    rig.node.sdo[0x6071].phys = 15.0
    rig.run(1000)  # no watchdog: nothing came by PDO
    drive = rig.bench
    assert drive.state is DriveState.OPERATION_ENABLED and drive.enabled == 1
    assert drive.motor_torque == pytest.approx(30.0, abs=drive.resolution)  # (1 + kp) tau_d
    assert rig.node.sdo[0x6074].phys == pytest.approx(15.0)
    rig.node.sdo[0x2002].raw = GainSet.SWING  # an integral of 10 1/s; without a bump
    assert drive.motor_torque == pytest.approx(30.0, abs=0.1)
    rig.run(300)
    assert drive.motor_torque == pytest.approx(30.0 + 10.0 * 15.0 * 0.1 + 15.0, abs=0.2)  # kp's share has faded in
    rig.node.sdo[0x6040].raw = 6
    assert (drive.state, drive.enabled) == (DriveState.READY_TO_SWITCH_ON, 0)


@pytest.mark.parametrize("mode", [Mode.IMPEDANCE, Mode.JOINT_POSITION, Mode.MOTOR_POSITION, Mode.OPEN_LOOP])
def test_any_mode_by_sdo_starts_with_set_points_that_move_nothing(rig, mode):
    drive = rig.bench
    drive.place(0.4, torque=12.0)
    rig.run(2)
    walk(rig, mode)
    rig.run(100)
    at_rest = -12.0 if mode in (Mode.IMPEDANCE, Mode.JOINT_POSITION) else 0.0  # kp (0 − tau): the spring is not relaxed
    assert drive.motor_torque == pytest.approx(at_rest, abs=0.1)


def test_stiffness_and_damping_of_impedance_are_commanded_by_sdo(rig):
    drive, sdo = rig.bench, rig.node.sdo
    drive.place(0.4)
    rig.run(2)
    walk(rig, Mode.IMPEDANCE)
    sdo[0x607A].phys = 0.5
    for stiffness in (20.0, 80.0):
        sdo[0x2018].raw = stiffness
        rig.run(100)
        assert drive.motor_torque == pytest.approx((1 + 1.0) * stiffness * 0.1, abs=0.1)  # (1 + kp) tau_d


def test_position_mode_by_sdo_starts_where_the_joint_is(rig):
    drive = rig.bench
    drive.place(0.4)
    rig.run(2)
    rig.node.sdo[0x607A].phys = -0.5  # before enabling: does not count
    walk(rig, Mode.POSITION)
    rig.run(100)
    assert drive.motor_torque == pytest.approx(0.0, abs=0.1)
    assert rig.node.sdo[0x607A].phys == pytest.approx(0.4, abs=1e-3)
    rig.node.sdo[0x607A].phys = 0.5
    rig.run(100)
    assert drive.motor_torque == pytest.approx(2 * 300.0 * 0.1, abs=0.5)
    rig.node.sdo[0x6060].raw = Mode.TORQUE  # a set-point does not outlive its mode
    rig.run(100)
    assert drive.motor_torque == pytest.approx(0.0, abs=0.1)


def test_no_old_set_point_acts_when_a_drive_is_enabled_again(rig):
    walk(rig)
    rig.node.sdo[0x6071].phys = 15.0
    rig.node.sdo[0x6040].raw = 7
    rig.node.sdo[0x6040].raw = 15
    rig.run(100)
    assert rig.bench.motor_torque == 0.0


def test_while_the_command_frame_flows_it_alone_commands(rig):
    drive = rig.bench.enable(torque=10.0)
    for index, value in ((0x6040, 6), (0x6060, Mode.POSITION), (0x6071, 100), (0x607A, 1000)):
        assert refused(rig, index, value) == 0x08000022
        drive.command(torque=10.0)
    assert drive.state is DriveState.OPERATION_ENABLED
    assert rig.node.sdo[0x6071].phys == pytest.approx(10.0, abs=0.1)  # reading tells what is in force
    assert rig.node.sdo[0x2200]["counter"].raw == drive.counter
    rig.node.sdo[0x2000]["kp"].raw = 2.0  # parameters can be written at any time
    drive.command(torque=10.0)
    assert drive.state is DriveState.OPERATION_ENABLED


def test_an_sdo_cannot_take_a_drive_over_on_the_tick_of_its_watchdog(rig):
    drive = rig.bench.enable(torque=10.0)
    rig.run(WATCHDOG_TICKS - 1)
    assert refused(rig, 0x6071, 0) == 0x08000022  # heard in the very tick in which the watchdog trips
    assert drive.state is DriveState.QUICK_STOP_ACTIVE


def test_after_a_lost_master_an_sdo_resets_and_takes_over(rig):
    drive = rig.bench.enable(torque=10.0)
    rig.run(WATCHDOG_TICKS + 1)
    rig.node.sdo[0x6040].raw = 0  # cuts the stop short; its cause stays
    assert drive.state is DriveState.FAULT
    rig.node.sdo[0x6040].raw = 0x80
    assert drive.state is DriveState.SWITCH_ON_DISABLED
    assert rig.emergencies() == [(0x8130, 0x11), (0, 0)]
    walk(rig)
    rig.run(100)
    assert drive.motor_torque == 0.0 and drive.state is DriveState.OPERATION_ENABLED


@settings(max_examples=30)
@given(st.integers(0, 0xFFFF), st.sampled_from([ENABLE, Controlword.DISABLE_VOLTAGE, Controlword.QUICK_STOP]))
def test_a_command_frame_takes_over_from_sdo_at_once_and_is_watched(bench, counter, word):
    rig = Rig(bench().boot())
    walk(rig)
    rig.node.sdo[0x6071].phys = 15.0
    drive = rig.bench
    drive.tick(drive.frame(word, counter=counter, torque=1.0))
    expected = {ENABLE: DriveState.OPERATION_ENABLED, Controlword.DISABLE_VOLTAGE: DriveState.SWITCH_ON_DISABLED,
                Controlword.QUICK_STOP: DriveState.QUICK_STOP_ACTIVE}  # fmt: skip
    assert drive.state is expected[word]
    assert refused(rig, 0x6071, 0) == 0x08000022
    rig.run(WATCHDOG_TICKS)
    assert drive.state is not DriveState.OPERATION_ENABLED


@pytest.mark.parametrize("cause", ["torque", "position", "stop", "pre-operational"])
def test_a_drive_commanded_by_sdo_is_protected_too(rig, cause):
    walk(rig)
    drive = rig.bench
    if cause == "torque":
        drive.place(torque=230.0)
    elif cause == "position":
        drive.place(drive.joint.limits[1] + 0.21)
    elif cause == "stop":
        rig.node.nmt.state = "STOPPED"
    else:
        rig.node.nmt.state = "PRE-OPERATIONAL"
    rig.run(1)
    expected = {"stop": DriveState.QUICK_STOP_ACTIVE, "pre-operational": DriveState.OPERATION_ENABLED}
    assert drive.state is expected.get(cause, DriveState.FAULT)
    assert drive.outputs[pins.ENABLE] == (cause in expected)


def test_the_stock_cia_402_node_walks_a_drive_through_its_states(bench):
    rig = Rig(bench().boot(), canopen.BaseNode402)
    node = rig.node
    rig.run(300)
    assert node.nmt.state == "OPERATIONAL"
    assert node.state == "SWITCH ON DISABLED"
    assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS TORQUE")
    assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS POSITION")
    assert not node.is_op_mode_supported("PROFILED POSITION")
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "QUICK STOP ACTIVE"):
        node.state = state
        assert node.state == state
    node.state = "SWITCH ON DISABLED"
    node.state = "OPERATION ENABLED"
    rig.bench.place(torque=300.0)
    rig.run(1)
    assert node.is_faulted() and rig.bench.enabled == 0
    rig.bench.place()
    rig.run(1)
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED" and rig.bench.enabled == 1
