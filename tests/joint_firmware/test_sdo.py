"""SDO access by a stock master: every object, every kind of transfer, every wrong request."""

import io
import math
import struct
from configparser import RawConfigParser

import canopen
import numpy as np
import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from canopen.objectdictionary.eds import import_eds, import_from_node
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bus import messages
from bus.messages import Controlword
from joint_firmware.drive import DriveState
from robots import pins

from .canopen_rig import GAINS, Rig


@pytest.fixture
def rig(bench):
    return Rig(bench(**GAINS).boot())


def variables(od):
    """Every variable of a dictionary of the canopen package."""
    for entry in od.values():
        if entry.index >= 0x1000:
            yield from [entry] if isinstance(entry, ODVariable) else entry.values()


# --- the dictionary -----------------------------------------------------------------------------------------


def test_a_scan_finds_the_drive_and_its_identity(rig):
    rig.network.scanner.reset()
    rig.network.scanner.search()
    assert rig.network.scanner.nodes == [2]
    identity = rig.node.sdo[0x1018]
    assert [identity[n].raw for n in range(5)] == [4, 0, 1, 0x10000, 2]
    assert rig.node.sdo[0x1000].raw & 0xFFFF == 402
    assert rig.node.sdo["Manufacturer device name"].raw == "hume right_hip"


def write_beyond(rig, var, limit, sign, code):
    """Write a value beyond ``limit`` and expect ``code``. Returns whether the type has such a value."""
    real = var.data_type in datatypes.FLOAT_TYPES
    beyond = limit + sign * max(abs(limit) * 1e-3, 1e-3) if real else int(limit) + sign
    try:
        data = var.STRUCT_TYPES[var.data_type].pack(beyond)
    except struct.error:
        return False
    with pytest.raises(canopen.SdoAbortedError) as caught:
        rig.node.sdo.download(var.index, var.subindex, data)
    assert caught.value.code == code, f"{var.index:#x}:{var.subindex}"
    return True


def test_the_data_sheet_is_the_live_dictionary(rig):
    """Names, types, access, defaults: what the EDS says of every object is what the drive does, and it says all."""
    live = rig.bench.firmware.dictionary
    od = rig.node.object_dictionary
    assert {i for i in od if i >= 0x1000} == set(live.objects)
    sheet = RawConfigParser()
    sheet.optionxform = str
    sheet.read_string(rig.sheet)
    checked = 0
    for var in variables(od):
        is_part = isinstance(var.parent, (ODRecord, ODArray))
        section = sheet[f"{var.index:04X}sub{var.subindex:X}" if is_part else f"{var.index:04X}"]
        try:
            data = rig.node.sdo.upload(var.index, var.subindex)
        except canopen.SdoAbortedError as abort:
            assert (var.index, abort.code) == (0x1003, 0x08000024)  # no error has happened
            continue
        if var.data_type in datatypes.NUMBER_TYPES:
            assert len(data) * 8 == len(var)
        if var.default is not None:
            value = var.decode_raw(data)
            assert value == (pytest.approx(var.default, rel=1e-6) if isinstance(value, float) else var.default)
        for key, code in (("LowLimit", 0x06090032), ("HighLimit", 0x06090031)):
            if var.writable and var.default is not None and key in section:
                checked += write_beyond(rig, var, float(section[key]), 1 if key == "HighLimit" else -1, code)
        if not var.writable:
            with pytest.raises(canopen.SdoAbortedError) as caught:
                rig.node.sdo.download(var.index, var.subindex, data[:4] or b"\0")
            assert caught.value.code == 0x06010002
    assert checked > 30  # limits
    for index in range(0x1000, 0x7000):
        if index not in od:
            assert rig.abort_code(0x40, index) == 0x06020000


def test_a_master_can_upload_the_data_sheet_itself(rig):
    assert rig.node.sdo.upload(0x1021, 0).decode() == rig.sheet
    od = import_from_node(2, rig.network)
    assert sorted(od) == sorted(rig.node.object_dictionary)


@pytest.mark.parametrize("joint", ["right_abduction", "left_knee"])
def test_cob_ids_of_the_sheet_follow_the_node(bench, joint):
    rig = Rig(bench(joint).boot())
    od, node_id = rig.node.object_dictionary, rig.bench.joint.node_id
    assert od[0x1014].default == 0x80 + node_id and od[0x1200][1].default == 0x600 + node_id
    assert od[0x1800][1].default == 0x40000180 + node_id
    for index, sub in ((0x1014, 0), (0x1200, 1), (0x1200, 2), (0x1800, 1)):
        raw = rig.node.sdo.upload(index, sub)
        assert int.from_bytes(raw, "little") == (od[index][sub] if sub else od[index]).default


def test_measured_values_are_those_of_the_state_frame(rig):
    drive, sdo = rig.bench, rig.node.sdo
    drive.place(0.3, 12.0)
    drive.inputs[pins.CURRENT_ADC] = -321
    drive.inputs[pins.SUPPLY_ADC] = 4812
    drive.run(200)
    state = drive.report
    assert sdo[0x6064].phys == pytest.approx(0.3, abs=1e-3) and sdo[0x6064].phys == pytest.approx(state.position)
    assert sdo[0x606C].phys == pytest.approx(state.velocity)
    assert sdo[0x6077].phys == pytest.approx(12.0, abs=0.1)  # thousandths of 150 N m
    assert sdo[0x6076].raw == 150_000 and sdo[0x6077].raw == 80
    assert sdo[0x6078].phys == pytest.approx(-3.21, abs=0.5 * sdo[0x6075].phys / 1000 + 1e-9)
    assert sdo[0x6079].phys == pytest.approx(48.12)
    assert sdo[0x2100]["torque"].phys == pytest.approx(state.torque)
    assert sdo[0x6041].raw == state.statusword == 0x40
    ticks = sdo[0x2030][1].raw
    assert sdo[0x2030][1].raw == ticks + 1


def test_the_stock_pdo_mapping_reads_the_state_frame(rig):
    drive, node = rig.bench, rig.node
    node.tpdo.read()
    drive.place(-0.2, 5.0)
    rig.run(100)
    pdo = node.tpdo[1]
    assert len(pdo.data) == messages.STATE_LENGTH == pdo.length // 8
    expected = struct.unpack("<" + messages.STATE_LAYOUT, pdo.data)
    assert [variable.raw for variable in pdo] == list(expected)
    assert pdo["Position actual value"].phys == pytest.approx(-0.2, abs=1e-3)


@pytest.mark.parametrize("joint", ["right_abduction", "right_hip", "right_knee"])
def test_the_stock_pdo_mapping_reads_the_command_frame(bench, joint):
    rig = Rig(bench(joint).boot())
    rig.node.rpdo.read()
    pdo = rig.node.rpdo[1]
    assert pdo.length == 8 * messages.COMMAND_LENGTH
    pdo.data = bytearray(rig.bench.frame(Controlword.SHUTDOWN, torque=12.5, position=0.25, gain_set=1).data)
    values = {variable.name: variable.phys for variable in pdo if variable.index == 0x2200}
    assert values["Command in force.torque"] == pytest.approx(12.5)
    assert values["Command in force.position"] == pytest.approx(0.25)
    assert (values["Command in force.controlword"], values["Command in force.gain_set"]) == (6, 1)
    assert values["Command in force.counter"] == rig.bench.counter


# --- parameters ---------------------------------------------------------------------------------------------


def test_a_gain_takes_effect_at_once_and_survives_until_the_reset(rig):
    drive, kp = rig.bench, rig.node.sdo[0x2000]["kp"]
    drive.enable(torque=14.0)
    for _ in range(60):
        drive.command(torque=14.0)
    before = drive.motor_torque  # (1 + kp) 14, the spring relaxed
    assert before == pytest.approx(28.0, abs=drive.resolution)
    word = drive.frame(Controlword.ENABLE_OPERATION, torque=14.0)
    drive.tick(word)
    assert kp.raw == 1.0
    kp.raw = 1.5
    # without a bump: the jump of the proportional part has gone into the fading integral
    assert drive.motor_torque == pytest.approx(before, abs=drive.resolution)
    for _ in range(3000):
        drive.command(torque=14.0)
    assert drive.motor_torque == pytest.approx(14.0 * 2.5, abs=2 * drive.resolution)
    assert kp.raw == 1.5 and rig.node.sdo[0x2001]["kp"].raw == 2.0


@pytest.mark.parametrize(
    ("index", "value"),
    [(0x2010, 0.02), (0x2011, 5e3), (0x2012, 100.0), (0x2013, 12.5), (0x2014, 80.0), (0x2015, 4.0),
     (0x2016, 55.0), (0x2017, 2.0), (0x2018, 44.0), (0x2019, 1.5), (0x201A, 90.0), (0x201B, 30.0), (0x201C, 7.0),
     (0x201D, 0.25), (0x201E, -0.5)],
)
def test_a_parameter_is_read_back_and_the_other_drives_do_not_hear_of_it(bench, rig, index, value):
    other = Rig(bench(**GAINS).boot())
    before = other.node.sdo[index].raw
    rig.node.sdo[index].raw = value
    assert rig.node.sdo[index].raw == pytest.approx(value, rel=1e-7)
    assert other.node.sdo[index].raw == before == Rig(bench().boot()).node.sdo[index].raw


def test_the_law_has_a_name_and_its_filter_a_bound(bench):
    rig = Rig(bench(law="PD_m+DOB", velocity_estimator="M/T").boot())
    sdo = rig.node.sdo
    assert (sdo[0x2003]["Torque loop"].raw, sdo[0x2003]["Velocity estimator"].raw) == ("PD_m+DOB", "M/T")
    names = rig.bench.firmware.law.parameters
    before = rig.bench.firmware._law.p_array.copy()
    sdo[0x201B].raw = 60.0
    changed = {names[n] for n in (rig.bench.firmware._law.p_array != before).nonzero()[0]}
    assert changed == {"observer_cutoff", "observer_half_step"}
    with pytest.raises(canopen.SdoAbortedError) as caught:
        sdo[0x201B].raw = 1400.0  # near half the interrupt's rate
    assert caught.value.code == 0x06090031


def test_gains_that_make_the_cascade_unstable_are_refused_and_change_nothing(bench):
    rig = Rig(bench(law="cascade").boot())
    ki = rig.node.sdo[0x2000]["ki"]
    ki.raw = 300.0
    with pytest.raises(canopen.SdoAbortedError) as caught:
        ki.raw = 6000.0
    assert caught.value.code == 0x06090030 and ki.raw == 300.0


def test_the_watchdog_is_as_long_as_it_was_written(rig):
    rig.node.sdo[0x2010].raw = 0.002
    drive = rig.bench.enable()
    drive.run(5)
    assert drive.state is DriveState.OPERATION_ENABLED
    drive.tick()
    assert drive.state is DriveState.QUICK_STOP_ACTIVE


def test_max_torque_bounds_what_the_command_frame_asks(rig):
    rig.node.sdo[0x6072].raw = 100  # 15 N m
    drive = rig.bench.enable()
    for _ in range(60):
        drive.command(torque=60.0)
    assert drive.motor_torque == pytest.approx(2 * 15.0, abs=drive.resolution)


def test_position_limits_move_the_soft_stop_within_the_joints_own(rig):
    sdo, drive = rig.node.sdo, rig.bench
    low, high = (sdo[0x607D][n].phys for n in (1, 2))
    assert (low, high) == pytest.approx(drive.joint.limits, abs=1e-6)
    sdo[0x607D][2].phys = 0.5
    with pytest.raises(canopen.SdoAbortedError) as caught:
        sdo[0x607D][1].phys = 0.6
    assert caught.value.code == 0x06090036 and sdo[0x607D][1].phys == pytest.approx(low, abs=1e-6)
    drive.place(0.7)
    drive.enable()
    for _ in range(60):
        drive.command()
    assert drive.motor_torque == pytest.approx(2 * -200.0 * 0.2, abs=0.1)  # (1 + kp) times the stop's torque


def test_a_calibration_moves_what_is_sensed_and_no_speed_appears(rig):
    sdo, drive = rig.node.sdo, rig.bench
    drive.place(0.5, 10.0)
    drive.run(50)
    sdo[0x2020]["Motor encoder offset"].raw = 0.125
    sdo[0x2020]["Spring encoder offset"].raw = -0.01
    rig.run(4)
    assert abs(sdo[0x606C].phys) < 1e-4
    stiffness = drive.joint.actuator.stiffness
    assert sdo[0x2100]["torque"].phys == pytest.approx(10.0 + 0.01 * stiffness, abs=0.05)
    assert sdo[0x6064].phys == pytest.approx(0.5 - 0.125 - 0.01, abs=1e-3)
    scale = sdo[0x2020]["Motor encoder scale"]
    scale.raw = 2 * scale.raw
    rig.run(2)
    assert sdo[0x6064].phys == pytest.approx((0.5 + 10.0 / stiffness) / 2 - 0.125 - 0.01 - 10.0 / stiffness, abs=1e-3)


def test_no_calibration_under_power(rig):
    rig.bench.enable()
    for sub in (1, 2, 3, 4):
        with pytest.raises(canopen.SdoAbortedError) as caught:
            rig.node.sdo.download(0x2020, sub, rig.node.sdo.upload(0x2020, sub))
        assert caught.value.code == 0x08000022


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_parameter_becomes_infinite(rig, value):
    assert rig.abort_code(0x23, 0x2000, 1, struct.pack("<f", value)) == 0x06090030
    assert rig.node.sdo[0x2000][1].raw == 1.0


# --- wrong requests: abort codes of CiA 301 -----------------------------------------------------------------

F32 = struct.pack("<f", 1.5)


@pytest.mark.parametrize(
    ("command", "index", "sub", "data", "code"),
    [
        (0x40, 0x5FFF, 0, b"", 0x06020000),  # read, no such object
        (0x23, 0x5FFF, 0, F32, 0x06020000),  # write
        (0x40, 0x1018, 5, b"", 0x06090011),
        (0x40, 0x6041, 1, b"", 0x06090011),
        (0x23, 0x2000, 4, F32, 0x06090011),
        (0x2B, 0x6041, 0, b"", 0x06010002),  # two bytes to the statusword
        (0x23, 0x1000, 0, b"", 0x06010002),
        (0x23, 0x1A00, 1, b"", 0x06010002),  # the mapping is fixed
        (0x2F, 0x2000, 1, b"\0", 0x06070013),  # one byte for a REAL32
        (0x2B, 0x2000, 1, b"\0\0", 0x06070013),
        (0x23, 0x6040, 0, b"\0\0", 0x06070012),  # four bytes for an UNSIGNED16
        (0x2B, 0x6060, 0, b"\0\0", 0x06070012),
        (0x23, 0x2000, 1, struct.pack("<f", 1e6), 0x06090031),
        (0x23, 0x2000, 1, struct.pack("<f", -1.0), 0x06090032),
        (0x2B, 0x6071, 0, struct.pack("<h", 1001), 0x06090031),
        (0x2B, 0x6071, 0, struct.pack("<h", -1001), 0x06090032),
        (0x2F, 0x6060, 0, b"\x01", 0x06090030),  # profile position: not supported
        (0x2F, 0x1800, 2, b"\xfc", 0x06090030),  # on remote request: not supported
        (0x2F, 0x1003, 0, b"\x01", 0x06090031),
        (0x21, 0x2000, 1, struct.pack("<I", 5), 0x06070012),  # segmented, a wrong size told
        (0x21, 0x2000, 1, struct.pack("<I", 3), 0x06070013),
        (0x21, 0x2000, 1, struct.pack("<I", 0xFFFFFFFF), 0x06070012),
        (0xA4, 0x1008, 0, b"", 0x05040001),  # block upload
        (0xC6, 0x2000, 1, b"", 0x05040001),  # block download
        (0xE0, 0, 0, b"", 0x05040001),
        (0x00, 0, 0, b"", 0x05040001),  # segments of no transfer
        (0x60, 0, 0, b"", 0x05040001),
    ],
)
def test_a_wrong_request_gets_the_abort_code_of_the_standard(rig, command, index, sub, data, code):
    before = rig.bench.firmware.snapshot()
    (answer,) = rig.raw(struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))
    assert answer == struct.pack("<BHBI", 0x80, index, sub, code)
    assert rig.bench.firmware.snapshot()["settings"] == before["settings"]
    assert rig.node.sdo[0x2000][1].raw == 1.0  # and the server goes on


def test_what_is_not_eight_bytes_long_is_counted_and_not_answered(rig):
    for request in (b"", b"\x40", bytes(7), b"\x40\x00\x10\x00\x00\x00\x00"):
        assert rig.raw(request) == []
    assert rig.node.sdo[0x2030][2].raw == 4 == rig.bench.firmware.malformed


# --- segmented transfers ------------------------------------------------------------------------------------


def test_strings_are_uploaded_and_numbers_downloaded_in_segments(rig):
    assert rig.node.sdo.upload(0x1008, 0) == b"hume right_hip"  # two segments of seven bytes
    rig.node.sdo.download(0x2000, 1, struct.pack("<f", 3.25), force_segment=True)
    assert rig.node.sdo[0x2000][1].raw == 3.25
    with rig.node.sdo.open(0x2000, 2, "wb", size=None, buffering=7) as stream:  # no size told
        stream.write(struct.pack("<f", 7.5))
    assert rig.node.sdo[0x2000][2].raw == 7.5


def test_a_segment_with_the_wrong_toggle_ends_the_transfer(rig):
    for command, data in ((0x40, b""), (0x21, b"\x04")):
        index, sub = (0x1008, 0) if command == 0x40 else (0x2000, 1)
        assert rig.abort_code(command, index, sub, data) is None
        segment = 0x70 if command == 0x40 else 0x10
        (answer,) = rig.raw(bytes([segment]) + bytes(7))
        assert answer == struct.pack("<BHBI", 0x80, index, sub, 0x05030000)
        assert rig.abort_code(segment) == 0x05040001  # it is over


def test_a_segment_of_the_other_direction_ends_the_transfer(rig):
    assert rig.abort_code(0x40, 0x1008) is None
    assert rig.abort_code(0x00) == 0x05040001
    assert rig.abort_code(0x60) == 0x05040001


def test_a_download_longer_or_shorter_than_its_object_changes_nothing(rig):
    for segments, code in (([0x00, 0x10], 0x06070012), ([0x0B], 0x06070013), ([0x01], 0x06070012)):
        assert rig.abort_code(0x20, 0x2000, 1) is None  # of no told size
        codes = []
        for command in segments:
            (answer,) = rig.raw(bytes([command]) + b"\x00\x00\x40\x40" + bytes(3))
            codes.append(struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else None)
        assert code in codes
        assert rig.node.sdo[0x2000][1].raw == 1.0


def test_a_client_that_falls_silent_is_told_so_in_firmware_time(rig):
    assert rig.abort_code(0x40, 0x1008) is None
    answers = [f for f in rig.run(15_000 - 1) if f.id == 0x582]
    assert answers == []
    (answer,) = [f for f in rig.run(1) if f.id == 0x582]
    assert answer.data == struct.pack("<BHBI", 0x80, 0x1008, 0, 0x05040000) and not answer.fd
    assert rig.abort_code(0x60) == 0x05040001


def test_a_client_may_abort_or_start_anew(rig):
    assert rig.abort_code(0x40, 0x1008) is None
    assert rig.raw(struct.pack("<BHBI", 0x80, 0x1008, 0, 0x08000000)) == []
    assert rig.abort_code(0x60) == 0x05040001
    assert rig.abort_code(0x40, 0x1008) is None
    assert rig.node.sdo[0x1018][4].raw == 2
    assert not [f for f in rig.run(20_000) if f.id == 0x582]  # nothing is left to expire


def test_an_expedited_download_without_a_size_is_as_long_as_its_object(rig):
    assert rig.abort_code(0x22, 0x2000, 1, struct.pack("<f", 2.5)) is None
    assert rig.node.sdo[0x2000][1].raw == 2.5
    assert rig.abort_code(0x22, 0x1017, 0, b"\xe8\x03\xff\xff") is None
    assert rig.node.sdo[0x1017].raw == 1000


# --- whatever comes -----------------------------------------------------------------------------------------

writable = [(0x1003, 0), (0x1017, 0), (0x1800, 2), (0x2000, 1), (0x2002, 0), (0x2010, 0), (0x201B, 0), (0x2020, 1),
            (0x6040, 0), (0x6060, 0), (0x6071, 0), (0x6072, 0), (0x607A, 0), (0x607D, 1), (0x607D, 2)]  # fmt: skip
aimed = st.builds(
    lambda command, place, data: struct.pack("<BHB", command, *place) + data,
    st.integers(0, 255), st.sampled_from(writable), st.binary(min_size=4, max_size=4),
)  # fmt: skip
segments = st.builds(
    lambda command, data: bytes([command]) + data, st.sampled_from([0x00, 0x01, 0x05, 0x07, 0x10, 0x15, 0x60, 0x70]),
    st.binary(min_size=7, max_size=7),
)  # fmt: skip
requests = st.one_of(st.binary(max_size=12), st.binary(min_size=8, max_size=8), aimed, segments)


PARAMETERS = [(0x1017, 0), (0x1800, 2), (0x2002, 0), (0x6072, 0), (0x607D, 1), (0x607D, 2),
              *[(index, 0) for index in range(0x2010, 0x201F)],
              *[(index, sub) for index in (0x2000, 0x2001) for sub in (1, 2, 3)],
              *[(0x2020, sub) for sub in (1, 2, 3, 4, 6)]]  # fmt: skip


def stored(rig):
    """Every parameter that outlives its request, as it would be read."""
    return {place: rig.bench.firmware.dictionary.read(*place) for place in PARAMETERS}


@settings(max_examples=200)
@given(st.lists(requests, min_size=1, max_size=30), st.booleans())
@example([b"\x21\x00\x20\x01\x04\x00\x00\x00", b"\x00\x00\x00\xc0\x7f\x00\x00\x00"], True)  # NaN in a segment
def test_random_requests_are_answered_and_change_only_what_they_name(bench, sequence, enabled):
    rig = Rig(bench().enable(torque=5.0) if enabled else bench().boot())
    begun = None  # object of the segmented download under way
    for request in sequence:
        if enabled:
            rig.bench.command(torque=5.0)
        before = stored(rig)
        answers = rig.raw(request)
        after = stored(rig)
        changed = {place for place in PARAMETERS if before[place] != after[place]}
        silent = len(request) != 8 or request[0] >> 5 == 4
        assert len(answers) == (0 if silent else 1)
        if silent:
            assert not changed
            continue
        (answer,) = answers
        asked, told = request[0] >> 5, answer[0] >> 5
        place = (request[1] | request[2] << 8, request[3])
        assert len(answer) == 8
        if told == 4:
            assert not changed and struct.unpack_from("<I", answer, 4)[0] in canopen.SdoAbortedError.CODES
            begun = None
            continue
        assert told == {0: 1, 1: 3, 2: 2, 3: 0}[asked]  # the answer to what was asked
        if asked in (1, 2):
            assert answer[1:4] == request[1:4]
        if asked == 1 and request[0] & 2:
            assert changed <= {place}
            if place in after:
                live = rig.bench.firmware.dictionary.variable(*place)
                low, high = (struct.unpack("<f", live.encode(v))[0] if live.type == 8 else v
                             for v in (live.low, live.high))  # fmt: skip
                value = int.from_bytes(after[place], "little", signed=live.type < 5)
                if live.type == 8:
                    (value,) = struct.unpack("<f", after[place])
                assert after[place] == request[4 : 4 + live.size]
                assert low is None or low <= value <= high
        elif asked == 0:
            assert changed <= {begun}
        else:
            assert not changed
        begun = place if asked == 1 and not request[0] & 2 else begun if asked == 0 else None
    assert np.isfinite(rig.bench.firmware.snapshot()["u"]).all()
    if enabled:  # nothing of this may have stopped the loop that goes on
        assert rig.bench.state is DriveState.OPERATION_ENABLED and not rig.bench.emergencies
    assert rig.node.sdo[0x607D][1].raw <= rig.node.sdo[0x607D][2].raw


@settings(max_examples=30)
@given(st.lists(requests, min_size=1, max_size=20), st.integers(0, 20))
def test_a_restored_server_goes_on_byte_for_byte(bench, sequence, at):
    first = Rig(bench().boot())
    for request in sequence[:at]:
        first.raw(request)
    snapshot = first.bench.firmware.snapshot()
    rest = [first.raw(request) for request in sequence[at:]] + first.run(15_100)
    another = Rig(bench().boot())
    another.node.sdo[0x2000][1].raw = 9.0
    another.bench.firmware.restore(snapshot)
    assert [another.raw(request) for request in sequence[at:]] + another.run(15_100) == rest


def test_a_data_sheet_needs_no_node_id(rig):
    od = import_eds(io.StringIO(rig.sheet), None)
    assert od[0x1000].default == 0x00020192
