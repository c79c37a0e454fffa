"""The DBC file of a robot's bus: names, order and layouts of ``bus.messages``, with units and value texts."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

from bus import messages
from bus.drive_faults import DriveFault
from bus.messages import Controlword, GainSet, Mode, NmtCommand, NmtState, Setpoint, State, Statusword
from robots.description import Bus, Robot

# The statusword as signals of its own, so that a drive's state has its name whatever the other bits are.
_STATUSWORD_BITS = (("drive_state", 0, 7), ("limited", 11, 1), ("foot_contact", 14, 1))
_CLASSICAL_BASE_FRAME, _FD_BASE_FRAME = 0, 14  # VFrameFormat StandardCAN, StandardCAN_FD
_FRAME_FORMATS = (
    "StandardCAN", "ExtendedCAN", "reserved", "J1939PG", *["reserved"] * 10,
    "StandardCAN_FD", "ExtendedCAN_FD",
)  # fmt: skip


class _Signal(NamedTuple):
    name: str
    start: int
    bits: int
    signed: bool
    scale: float = 1.0
    unit: str = ""

    def line(self, receiver: str) -> str:
        place = f"{self.start}|{self.bits}@1{'-' if self.signed else '+'}"
        return f' SG_ {self.name} : {place} ({self.scale:g},0) [0|0] "{self.unit}" {receiver}'


def _signals(names: tuple[str, ...], layout: str, first_bit: int = 0, prefix: str = "") -> Iterator[_Signal]:
    """One signal per field of a struct ``layout``."""
    start = first_bit
    for name, code in zip(names, layout, strict=True):
        bits = 8 * struct.calcsize("<" + code)
        if name == "statusword":
            for part, offset, width in _STATUSWORD_BITS:
                yield _Signal(prefix + part, start + offset, width, False)
        else:
            yield _Signal(prefix + name, start, bits, code.islower(), *messages.UNITS.get(name, (1.0, "")))
        start += bits


def _texts(table: type, leave_out: tuple[str, ...] = ()) -> str:
    entries = {name: value for name, value in vars(table).items() if name.isupper() and name not in leave_out}
    return " ".join(f'{value} "{name}"' for name, value in entries.items())


_TEXTS = {
    "drive_state": _texts(Statusword, leave_out=("MASK", "FOOT_CONTACT", "LIMITED")),
    "controlword": _texts(Controlword),
    "mode": _texts(Mode),
    "gain_set": _texts(GainSet),
    "error": _texts(DriveFault),
    "nmt_state": _texts(NmtState),
    "nmt_command": _texts(NmtCommand),
}


def dbc(robot: Robot, bus: Bus) -> str:
    """Text of the DBC file of ``bus``: the command (a set of signals per joint, prefixed with its name), each
    drive's state, heartbeat and emergency, and the services of a CANopen master.

    Raises ValueError for a bus with more drives than a command has slots.
    """
    joints = robot.joints_of(bus)
    if len(joints) > messages.SLOTS:
        raise ValueError(f"bus {bus.name} has {len(joints)} drives; a command has {messages.SLOTS} slots")
    nodes = " ".join(["gateway", "master", *bus.joints])
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", f"BU_: {nodes}", ""]
    values: list[str] = []
    formats: list[tuple[int, int]] = []

    def message(
        identifier: int, name: str, length: int, sender: str, signals: list[tuple[_Signal, str]],
        frame_format: int = _FD_BASE_FRAME,
    ) -> None:  # fmt: skip
        formats.append((identifier, frame_format))
        lines.append(f"BO_ {identifier} {name}: {length} {sender}")
        for signal, receiver in signals:
            lines.append(signal.line(receiver))
            for field, texts in _TEXTS.items():
                if signal.name == field or signal.name == f"{receiver}_{field}":
                    values.append(f"VAL_ {identifier} {signal.name} {texts} ;")
        lines.append("")

    command = [(_Signal("counter", 0, 16, False), joints[0].name)]
    at = 8 * struct.calcsize("<" + messages.COMMAND_HEADER_LAYOUT)
    for joint in joints:
        slot = _signals(Setpoint._fields, messages.SLOT_LAYOUT, at, f"{joint.name}_")
        command += [(signal, joint.name) for signal in slot]
        at += 8 * struct.calcsize("<" + messages.SLOT_LAYOUT)
    message(messages.COMMAND, "command", messages.COMMAND_LENGTH, "gateway", command)

    state = list(_signals(State._fields, messages.STATE_LAYOUT))
    heartbeat = [_Signal("nmt_state", 0, 8, False)]
    emergency = [_Signal("error_code", 0, 16, False), _Signal("error_register", 16, 8, False)]
    for joint in joints:
        for base, name, length, signals in (
            (messages.STATE, "state", messages.STATE_LENGTH, state),
            (messages.HEARTBEAT, "heartbeat", 1, heartbeat),
            (messages.EMERGENCY, "emergency", messages.EMERGENCY_LENGTH, emergency),
        ):
            sent = [(signal, "gateway") for signal in signals]
            message(base + joint.node_id, f"{joint.name}_{name}", length, joint.name, sent)

    # what a master that speaks classical CAN sends, and the answers, which are in the form of the request
    nmt = [(_Signal(name, start, 8, False), joints[0].name) for name, start in (("nmt_command", 0), ("node", 8))]
    message(messages.NMT, "nmt", 2, "master", nmt, _CLASSICAL_BASE_FRAME)
    message(messages.SYNC, "sync", 0, "master", [], _CLASSICAL_BASE_FRAME)
    sdo = [_Signal("sdo_command", 0, 8, False), _Signal("index", 8, 16, False), _Signal("sub", 24, 8, False),
           _Signal("data", 32, 32, False)]  # fmt: skip
    for joint in joints:
        for base, name, sender, receiver in (
            (messages.SDO_REQUEST, "sdo_request", "master", joint.name),
            (messages.SDO_RESPONSE, "sdo_response", joint.name, "master"),
        ):
            parts = [(signal, receiver) for signal in sdo]
            message(base + joint.node_id, f"{joint.name}_{name}", 8, sender, parts, _CLASSICAL_BASE_FRAME)

    format_names = ",".join(f'"{name}"' for name in _FRAME_FORMATS)
    lines += [
        f'BA_DEF_ BO_ "VFrameFormat" ENUM {format_names};',
        'BA_DEF_ "BusType" STRING ;',
        'BA_DEF_DEF_ "VFrameFormat" "StandardCAN_FD";',
        'BA_DEF_DEF_ "BusType" "CAN FD";',
        'BA_ "BusType" "CAN FD";',
        *[f'BA_ "VFrameFormat" BO_ {identifier} {frame_format};' for identifier, frame_format in formats],
        *values,
        "",
    ]
    return "\n".join(lines)
