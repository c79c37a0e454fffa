"""Every place where bytes enter that this project did not write: each target takes any bytes and raises when something
other than the documented happens. Shared by the property tests and the coverage-guided fuzzer (``tests.fuzz.run``)."""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import math
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from bus import messages
from bus.candump import format_line
from bus.dbc import dbc
from bus.frames import CAN_FD_LENGTHS, Frame, checked
from bus.gateway import Gateway
from bus.messages import MalformedMessageError
from bus.records import MalformedRecordError, pack_frame, unpack_frame
from bus.shm_port import ShmPort
from bus.zenoh_link import MalformedBundleError, decode_bundle, encode_bundle
from hil.analysis.latency import state_latencies
from hil.errors import UserError
from hil.record.mcap_writer import McapWriter
from hil.record.signals import SIGNALS_FILE, load_tables
from hil.scenario import load, parse_value
from robots import description, motion_capture, pins

ROBOT = description.load("hume")
BUS = ROBOT.buses[0]


class Target(NamedTuple):
    check: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]  # well-formed input to start from


# --- records on a socket, slots in shared memory --------------------------------------------------------------

_FRAMES = [
    Frame(0x200, bytes(64)), Frame(0x181, bytes(range(24))), Frame(0x1FFFFFFF, b"\x01", False, False, True),
    Frame(0, b""), Frame(0x7FF, bytes(8), True, False),
]  # fmt: skip


def record(data: bytes) -> None:
    try:
        time_ns, sender, frame = unpack_frame(data)
    except MalformedRecordError:
        return
    assert checked(frame) is frame
    again = pack_frame(frame, time_ns, sender)
    assert unpack_frame(again) == (time_ns, sender, frame)


def ring(data: bytes) -> None:
    memory = bytearray(ShmPort.SIZE)
    memory[: len(data)] = data[: ShmPort.SIZE]
    port = ShmPort(memoryview(memory))
    for frame in port.recv_frames():
        checked(frame)
    assert port.recv_frames() == []  # nothing is read twice
    other = ShmPort(memoryview(bytearray(ShmPort.SIZE)))
    assert other.send_frame(_FRAMES[0]) and other.malformed == 0


def _rings() -> list[bytes]:
    memory = bytearray(ShmPort.SIZE)
    port = ShmPort(memoryview(memory), firmware=True)
    for frame in _FRAMES:
        port.send_frame(frame)
    return [bytes(memory)]


# --- payloads on the bus --------------------------------------------------------------------------------------


@functools.cache
def _database() -> Any:
    import cantools

    return cantools.database.load_string(dbc(ROBOT, BUS), "dbc")


def payload(data: bytes) -> None:
    """What our codecs read from a payload is what cantools reads by the generated DBC, and it encodes to the same."""
    try:
        state = messages.decode_state(data)
    except MalformedMessageError:
        assert len(data) != messages.STATE_LENGTH
    else:
        assert messages.encode_state(state) == data
        signals = _database().get_message_by_frame_id(messages.STATE + 1).decode(data, decode_choices=False)
        assert signals["counter"] == state.counter and signals["error"] == state.error
        assert signals["drive_state"] == state.statusword & 0x7F
        for name in ("position", "velocity", "torque", "current", "motor_velocity"):
            assert math.isclose(signals[name], getattr(state, name), rel_tol=1e-9, abs_tol=1e-12), name
    for slot in range(messages.SLOTS):
        try:
            setpoint = messages.decode_setpoint(data, slot)
        except MalformedMessageError:
            assert len(data) != messages.COMMAND_LENGTH
            continue
        encoded = messages.encode_command(messages.command_counter(data), [setpoint] * messages.SLOTS)
        assert messages.decode_setpoint(encoded, slot) == setpoint
        signals = _database().get_message_by_frame_id(messages.COMMAND).decode(data, decode_choices=False)
        joint = BUS.joints[slot]
        for name in ("torque", "position", "velocity", "torque_limit"):
            assert math.isclose(signals[f"{joint}_{name}"], getattr(setpoint, name), rel_tol=1e-9, abs_tol=1e-12)
    with contextlib.suppress(MalformedMessageError):
        assert messages.encode_emergency(*messages.decode_emergency(data)) == data


def gateway(data: bytes) -> None:
    """A frame or a command of any content: forwarded whole, or counted."""
    if len(data) < 6:
        return
    bus, identifier = data[0], int.from_bytes(data[1:5], "little")
    content, node = data[5:], Gateway(ROBOT)
    try:
        to, frame = node.from_link((bus, identifier, content))
    except MalformedMessageError:
        assert node.malformed == 1
    else:
        assert (to, frame) == (bus, Frame(messages.COMMAND, content)) and bus < len(ROBOT.buses)
    before = node.ignored + node.malformed
    item = node.from_can(0, bus % len(ROBOT.buses), Frame(identifier & 0x7FF, content, extended=bool(bus & 128)))
    assert (item is None) == (node.ignored + node.malformed == before + 1)
    assert item is None or item == (bus % len(ROBOT.buses), identifier & 0x7FF, content)


@functools.cache
def _drive() -> tuple[Any, Any, np.ndarray, np.ndarray]:
    from hil.compiled import compile_function
    from joint_firmware.config import FirmwareConfig
    from joint_firmware.firmware import JointFirmware

    node = JointFirmware(ROBOT, 0, FirmwareConfig(), compile=compile_function)
    inputs, outputs = np.zeros(pins.N_INPUTS, np.int32), np.zeros(pins.N_OUTPUTS, np.int32)
    node.attach(inputs, outputs)
    return node, node.snapshot(), inputs, outputs


def firmware(data: bytes) -> None:
    """A drive that gets any frames and any pins: it sends valid frames, and without power its demand is zero."""
    node, fresh, inputs, outputs = _drive()
    node.restore(fresh)
    inputs[:] = 0
    chunks = [data[n : n + 66] for n in range(0, min(len(data), 8 * 66), 66)]
    for tick, chunk in enumerate(chunks * 2):
        identifier = messages.COMMAND if chunk[0] & 1 else int.from_bytes(chunk[:2], "little") & 0x7FF
        length = max(n for n in CAN_FD_LENGTHS if n <= max(len(chunk) - 2, 0))
        raw = chunk[:4].ljust(4, b"\0") * pins.N_INPUTS if chunk[0] & 2 else bytes(4 * pins.N_INPUTS)
        inputs[:] = np.frombuffer(raw, "<i4")
        for frame in node.tick(tick * 333_333, [Frame(identifier, chunk[2 : 2 + length])]):
            checked(frame)
        assert outputs[pins.ENABLE] in (0, 1)
        assert outputs[pins.ENABLE] or outputs[pins.CURRENT_DEMAND] == 0


def _commands() -> list[bytes]:
    walk = (0x80, 0x06, 0x07, 0x0F)
    setpoints = [
        messages.Setpoint(word, messages.Mode.TORQUE, 0, 20.0, 0.1, 0.0, 100.0, n) for n, word in enumerate(walk)
    ]
    frames = [b"\1\0" + messages.encode_command(n + 1, [s] * messages.SLOTS) for n, s in enumerate(setpoints)]
    return [b"".join(frames), *frames]


_BOOT_TICKS = 70
_GAIN = bytes.fromhex("4000200100000000")  # upload of 0x2000:1, stance kp


def sdo(data: bytes) -> None:
    """A booted drive that is asked anything by SDO: it answers each request with eight bytes or none, and whatever has
    been written, its gains stay finite and not negative."""
    node, fresh, inputs, _ = _drive()
    node.restore(fresh)
    inputs[:] = 0
    identifier = ROBOT.joints[0].node_id
    for tick in range(_BOOT_TICKS):
        node.tick(tick * 333_333, [])

    def ask(tick: int, request: bytes) -> bytes | None:
        sent = node.tick(tick * 333_333, [Frame(messages.SDO_REQUEST + identifier, request, False, False)])
        answers = [checked(frame).data for frame in sent if frame.id == messages.SDO_RESPONSE + identifier]
        assert len(answers) <= 1 and all(len(answer) == 8 for answer in answers)
        return answers[0] if answers else None

    requests = [data[n : n + 8] for n in range(0, min(len(data), 40 * 8), 8)]
    for n, request in enumerate(requests):
        ask(_BOOT_TICKS + n, request)
    answer = ask(_BOOT_TICKS + len(requests), _GAIN)
    if answer is not None and answer[0] == 0x43:  # not in NMT stopped or rebooting
        gain = struct.unpack_from("<f", answer, 4)[0]
        assert math.isfinite(gain) and gain >= 0


def _requests() -> list[bytes]:
    upload = bytes.fromhex("4018100100000000")  # identity
    segmented = bytes.fromhex("4008100000000000 6000000000000000 7000000000000000")  # device name
    gain = bytes.fromhex("23002001") + struct.pack("<f", 2.0)
    controlword = bytes.fromhex("2b40600006000000")
    return [upload, segmented, gain, gain + _GAIN, controlword, bytes.fromhex("8008100000000405")]


# --- the Zenoh link -------------------------------------------------------------------------------------------


def bundle(data: bytes) -> None:
    try:
        found = decode_bundle(data)
    except MalformedBundleError:
        return
    assert encode_bundle(found.sequence, found.time_ns, found.items, found.values) == data


def _bundles() -> list[bytes]:
    return [
        encode_bundle(7, 10**9, [(1, 0, 0x181, bytes(24)), (2, 255, 0, bytes(12))], np.arange(5.0)),
        encode_bundle(0, 0, []),
    ]


def camera_frame(data: bytes) -> None:
    assert ROBOT.motion_capture is not None
    try:
        frame = motion_capture.decode(data, ROBOT.motion_capture)
    except motion_capture.MalformedFrameError:
        return
    assert motion_capture.encode(frame, ROBOT.motion_capture) == data


def _camera_frames() -> list[bytes]:
    assert ROBOT.motion_capture is not None
    n = len(ROBOT.motion_capture.leds)
    seen = np.arange(n) % 3 > 0
    return [
        motion_capture.encode(
            motion_capture.Frame(10**9, 480, seen.astype(float), np.ones((n, 3))), ROBOT.motion_capture
        )
    ]


_OPEN = contextlib.ExitStack()  # closed with this process
atexit.register(_OPEN.close)


class _AtOnce:
    """Requests that are carried out as they are handed over: the calendar does it between two events."""

    def append(self, request: Callable[[], None]) -> None:
        request()


@functools.cache
def _answer() -> Callable[[Any], None]:
    """A run's answer to an injection over Zenoh, without the session. The run stands still."""
    from hil import control
    from hil.run import Request, assemble

    queries: list[Callable[[Any], None]] = []
    assembly = _OPEN.enter_context(assemble(Request(load("stand"), backend="inline")))
    assembly.system.requests = _AtOnce()
    assembly.session = SimpleNamespace(declare_queryable=lambda key, answer: queries.append(answer))
    control.serve_run(assembly)
    return queries[0]


def injection(data: bytes) -> None:
    """Any payload of an injection gets one JSON answer: a value and a time, or a sentence."""
    replies: list[bytes] = []
    payload_ = SimpleNamespace(to_bytes=lambda: data)
    _answer()(SimpleNamespace(payload=payload_, key_expr="k", reply=lambda key, reply: replies.append(reply)))
    (reply,) = map(json.loads, replies)
    if "error" in reply:
        assert isinstance(reply["error"], str) and reply["error"]
    else:
        assert _plain(reply["value"])


def _injections() -> list[bytes]:
    orders = [("link.command.delay", "3ms"), ("bus.left_leg.loss", 0.01), ("bus.left_leg.bit_error_rate", "1e-5")]
    return [json.dumps({"key": key, "value": value}).encode() for key, value in orders]


def _plain(value: object) -> bool:
    """A name, a switch, or a finite number."""
    return isinstance(value, str | bool) or (isinstance(value, int | float) and math.isfinite(value))


def setting(data: bytes) -> None:
    """KEY=VALUE from the command line: a finite number, or a sentence."""
    key, _, value = data.decode("utf-8", "replace").partition("=")
    with contextlib.suppress(UserError):
        assert _plain(parse_value(key, value))


def _settings() -> list[bytes]:
    return [b"link.command.delay=3ms", b"bus.left_leg.loss=0.01", b"firmware.rate=3kHz", b"controller.path.kind=hold"]


def background_text(data: bytes) -> None:
    from hil.commands.bus_load import background

    with contextlib.suppress(UserError):
        traffic = background(data.decode("utf-8", "replace"))
        assert traffic.period >= 1000 and traffic.length in CAN_FD_LENGTHS


# --- files ----------------------------------------------------------------------------------------------------


@functools.cache
def _directory() -> Path:
    _directory.keep = tempfile.TemporaryDirectory()  # type: ignore[attr-defined]  # removed with this process
    return Path(_directory.keep.name)  # type: ignore[attr-defined]


def candump_log(data: bytes) -> None:
    path = _directory() / "bus.log"
    path.write_bytes(data)
    seconds, latencies = state_latencies(path, 3000, 1500)
    assert seconds.shape == latencies.shape
    assert np.isfinite(seconds).all() and np.isfinite(latencies).all()


def _logs() -> list[bytes]:
    times = [(1_000_000 * n, Frame(0x181, struct.pack("<H", n) + bytes(22))) for n in range(3)]
    beyond_64_bits = b"(" + b"3" * 50 + b".000000000) left_leg 182##70000\n"
    return ["".join(format_line(t, "left_leg", f) + "\n" for t, f in times).encode(), beyond_64_bits]


def signals(data: bytes) -> None:
    """A record that was cut off or damaged: what is read has the shape of a table; anything else is a sentence."""
    (_directory() / SIGNALS_FILE).write_bytes(data)
    try:
        tables = load_tables(_directory())
    except UserError:
        return
    for table in tables.values():
        assert table.data.shape == (len(table.times), len(table.names))


def _records() -> list[bytes]:
    path = _directory() / "seed.mcap"
    writer = McapWriter(path, {"world": ["com.x", "com.z"], "bus": ["load.left_leg"]})
    for n in range(2):
        times = np.arange(3) + 3 * n
        writer.write("world", times, np.arange(6.0).reshape(3, 2))
        writer.write("bus", times, np.ones((3, 1)))
    writer.flush()
    killed = path.read_bytes()
    writer.close()
    return [path.read_bytes(), killed]


TARGETS = {
    "record": Target(record, lambda: [pack_frame(f, 12345, 2) for f in _FRAMES]),
    "ring": Target(ring, _rings),
    "payload": Target(payload, lambda: [bytes(24), bytes(64), bytes(8), *(c[2:] for c in _commands())]),
    "gateway": Target(gateway, lambda: [b"\1\0\2\0\0" + bytes(64), b"\0\x81\1\0\0" + bytes(24)]),
    "firmware": Target(firmware, _commands),
    "sdo": Target(sdo, _requests),
    "bundle": Target(bundle, _bundles),
    "camera_frame": Target(camera_frame, _camera_frames),
    "injection": Target(injection, _injections),
    "setting": Target(setting, _settings),
    "background": Target(background_text, lambda: [b"0x050:8:1ms"]),
    "candump": Target(candump_log, _logs),
    "signals": Target(signals, _records),
}
