"""The gateway, and the files that stock tools read: DBC by cantools, log lines by python-can and cantools."""

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from cantools.logreader import Parser
from hypothesis import given
from hypothesis import strategies as st

from bus import messages
from bus.candump import format_line
from bus.dbc import dbc
from bus.frames import CAN_FD_LENGTHS, Frame
from bus.gateway import Gateway
from robots import description

ROBOT = description.load("hume")
BUSES = list(enumerate(ROBOT.buses))
DATABASES: list[Any] = [cantools.database.load_string(dbc(ROBOT, bus), "dbc") for bus in ROBOT.buses]
SCALED = {"position": 1e-6, "velocity": 1e-5, "torque": 1e-4, "current": 0.01, "motor_velocity": 1e-3}


@pytest.mark.parametrize("index, bus", BUSES)
def test_states_and_emergencies_go_up_and_nothing_else(index: int, bus: description.Bus) -> None:
    gateway = Gateway(ROBOT)
    for joint in ROBOT.joints_of(bus):
        state = Frame(messages.STATE + joint.node_id, bytes(messages.STATE_LENGTH))
        assert gateway.from_can(0, index, state) == (index, state.id, state.data)
        emergency = Frame(messages.EMERGENCY + joint.node_id, bytes(8))
        assert gateway.from_can(0, index, emergency) == (index, emergency.id, emergency.data)
        assert gateway.from_can(0, 1 - index, state) is None  # not this bus's node
        assert gateway.from_can(0, index, state._replace(extended=True)) is None
        assert gateway.from_can(0, index, Frame(messages.HEARTBEAT + joint.node_id, b"\x05")) is None
    other = Gateway(ROBOT)
    other.restore(gateway.snapshot())
    assert other.snapshot() == gateway.snapshot() != Gateway(ROBOT).snapshot()


def test_a_command_goes_down_to_its_bus() -> None:
    data = messages.encode_command(1, [])
    assert Gateway(ROBOT).from_link((1, messages.COMMAND, data)) == (1, Frame(messages.COMMAND, data))


reals = st.floats(-400, 400)


@given(
    st.sampled_from(BUSES), st.integers(0, 2), reals, reals, reals, st.floats(-30, 30), st.integers(0, 65535)
)
def test_cantools_reads_a_drive_state_as_the_codec_does(
    which: tuple[int, description.Bus],
    n: int,
    position: float,
    velocity: float,
    torque: float,
    small: float,
    counter: int,
) -> None:
    index, bus = which
    joint = ROBOT.joints_of(bus)[n]
    status = messages.Statusword.OPERATION_ENABLED | messages.Statusword.FOOT_CONTACT
    data = messages.encode_state(
        messages.State(counter, status, position, velocity, torque, small, small, counter, 3, 40)
    )
    read = DATABASES[index].decode_message(messages.STATE + joint.node_id, data)
    ours = messages.decode_state(data)
    for name, scale in SCALED.items():
        assert read[name] == pytest.approx(getattr(ours, name), abs=1e-3 * scale)
    assert (read["counter"], read["command_counter"], read["error"], read["temperature"]) == (
        counter,
        counter,
        "JOINT_ENCODER",
        40,
    )
    assert str(read["drive_state"]) == "OPERATION_ENABLED"
    assert (read["foot_contact"], read["limited"]) == (1, 0)


@given(st.sampled_from(BUSES), reals, reals, reals, st.floats(0, 1000), st.integers(0, 65535))
def test_cantools_writes_a_command_that_the_codec_reads(
    which: tuple[int, description.Bus],
    torque: float,
    position: float,
    velocity: float,
    limit: float,
    counter: int,
) -> None:
    index, bus = which
    values: dict[str, float | str] = {"counter": counter}
    for n, joint in enumerate(ROBOT.joints_of(bus)):
        values |= {
            f"{joint.name}_controlword": "ENABLE_OPERATION",
            f"{joint.name}_mode": -1,
            f"{joint.name}_gain_set": 1,
            f"{joint.name}_torque": torque + n,
            f"{joint.name}_position": position,
            f"{joint.name}_velocity": velocity,
            f"{joint.name}_torque_limit": limit,
            f"{joint.name}_state_counter": counter,
        }
    data = DATABASES[index].encode_message(messages.COMMAND, values, strict=False)
    assert messages.command_counter(data) == counter
    for n in range(3):
        read = messages.decode_setpoint(data, n)
        assert (read.controlword, read.mode, read.gain_set, read.state_counter) == (15, -1, 1, counter)
        assert read.torque == pytest.approx(torque + n, abs=0.51e-4)
        assert read.position == pytest.approx(position, abs=0.51e-6)
        assert read.velocity == pytest.approx(velocity, abs=0.51e-5)
        assert read.torque_limit == pytest.approx(limit, abs=0.0101)


def test_every_message_of_the_dbc_is_a_frame_of_its_length_and_kind() -> None:
    for (_, bus), database in zip(BUSES, DATABASES, strict=True):
        expected = {messages.COMMAND: 64}
        services = {messages.NMT: 2, messages.SYNC: 0}
        for joint in ROBOT.joints_of(bus):
            services |= {base + joint.node_id: 8 for base in (messages.SDO_REQUEST, messages.SDO_RESPONSE)}
        for joint in ROBOT.joints_of(bus):
            expected |= {messages.STATE + joint.node_id: 24, messages.HEARTBEAT + joint.node_id: 1}
            expected[messages.EMERGENCY + joint.node_id] = 8
        assert {m.frame_id: m.length for m in database.messages if m.is_fd} == expected
        assert {m.frame_id: m.length for m in database.messages if not m.is_fd} == services
        assert not any(m.is_extended_frame for m in database.messages)


def test_cantools_reads_an_emergency() -> None:
    joint = ROBOT.joints_of(ROBOT.buses[0])[0]
    read = DATABASES[0].decode_message(
        messages.EMERGENCY + joint.node_id, messages.encode_emergency(0x7305, 0x21)
    )
    assert (read["error_code"], read["error_register"]) == (0x7305, 0x21)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended, fd = draw(st.booleans()), draw(st.booleans())
    length = draw(st.sampled_from(CAN_FD_LENGTHS if fd else range(9)))
    data = draw(st.binary(min_size=length, max_size=length))
    return Frame(
        draw(st.integers(0, 2 ** (29 if extended else 11) - 1)),
        data,
        fd,
        fd and draw(st.booleans()),
        extended,
    )


@given(st.integers(0, 10**13), frames())
def test_python_can_reads_a_log_line_back(time_ns: int, frame: Frame) -> None:
    (read,) = can.CanutilsLogReader(io.StringIO(format_line(time_ns, "left_leg", frame) + "\n"))
    assert read.timestamp == pytest.approx(time_ns * 1e-9, abs=1e-9 + time_ns * 1e-25)
    assert read.channel == "left_leg"
    assert (
        read.arbitration_id,
        bytes(read.data),
        read.is_fd,
        read.bitrate_switch,
        read.is_extended_id,
    ) == frame[:5]


@given(frames())
def test_cantools_reads_a_log_line_back(frame: Frame) -> None:
    read = Parser(io.StringIO()).parse(format_line(1_234_567_891, "left_leg", frame))
    assert read is not None
    assert (read.channel, read.frame_id, read.data, read.is_extended_frame) == (
        "left_leg", frame.id, frame.data, frame.extended)  # fmt: skip


def test_a_line_keeps_all_nine_digits() -> None:
    line = format_line(12_000_000_345, "left_leg", Frame(0x181, b"\x01\x02"))
    assert line == "(12.000000345) left_leg 181##50102"


def test_the_command_line_of_cantools_decodes_a_log(tmp_path: Path) -> None:
    path = tmp_path / "bus.dbc"
    path.write_text(dbc(ROBOT, ROBOT.buses[0]), encoding="utf-8")
    joint = ROBOT.joints_of(ROBOT.buses[0])[1]
    state = messages.State(7, messages.Statusword.FAULT, 0.25, 0.0, -12.5, 0.0, 0.0, 0, 0, 25)
    line = format_line(
        1_000_000_001, "can0", Frame(messages.STATE + joint.node_id, messages.encode_state(state))
    )
    done = subprocess.run([sys.executable, "-m", "cantools", "decode", "--single-line", str(path)],
                          input=line + "\n", capture_output=True, text=True, check=True)  # fmt: skip
    assert f"{joint.name}_state(" in done.stdout
    assert "drive_state: FAULT" in done.stdout and "torque: -12.5" in done.stdout
