"""Every message on the joint buses: identifiers (CiA 301), layouts (little-endian), and their codecs.

This module is the one definition; DBC files (``bus.dbc``) and EDS files (``joint_firmware.eds``) are generated from it.
All physical values are fixed-point integers with the scales below.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

# --- identifiers (CiA 301 pre-defined connection set) -------------------------------------------------------
NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080  # + node id
STATE = 0x180  # TPDO1 + node id
COMMAND = 0x200  # RPDO1, one broadcast for all drives of the bus
SDO_RESPONSE = 0x580  # + node id
SDO_REQUEST = 0x600  # + node id
HEARTBEAT = 0x700  # + node id


def accepted(node_id: int) -> tuple[int, ...]:
    """Identifiers that the CAN controller of a drive lets pass."""
    return NMT, SYNC, COMMAND, SDO_REQUEST + node_id


# --- scales -------------------------------------------------------------------------------------------------
RADIAN = 1e-6  # rad per count
RADIAN_PER_SECOND = 1e-5  # rad/s per count
NEWTON_METRE = 1e-4  # N m per count
TORQUE_LIMIT = 0.02  # N m per count, unsigned 16 bit
AMPERE = 0.01  # A per count
MOTOR_RADIAN_PER_SECOND = 1e-3  # rad/s per count, 16 bit
UNITS = {  # scale and unit of every field that has one
    "position": (RADIAN, "rad"),
    "velocity": (RADIAN_PER_SECOND, "rad/s"),
    "torque": (NEWTON_METRE, "N m"),
    "torque_limit": (TORQUE_LIMIT, "N m"),
    "current": (AMPERE, "A"),
    "motor_velocity": (MOTOR_RADIAN_PER_SECOND, "rad/s"),
    "temperature": (1.0, "degC"),
}
SLOTS = 3  # drives that one command frame can address


class Mode:
    """Mode of operation of a drive (CiA 402 numbers; manufacturer-specific ones are negative)."""

    NONE = 0
    TORQUE = 10  # cyclic synchronous torque
    POSITION = 8  # cyclic synchronous position
    DAMPING = -1  # brake by motor velocity
    OPEN_LOOP = -2  # torque of the motor, without a torque loop
    MOTOR_POSITION = -3  # position of the motor, without a torque loop (Kim 2018 (5.23))
    JOINT_POSITION = -4  # position of the joint around the torque loop (Kim 2018 Fig. 7.1)
    IMPEDANCE = -5  # commanded torque, stiffness and damping of the joint around the torque loop


class GainSet:
    """Torque gains of a drive, switched by command (Kim 2018 §5.1.1)."""

    STANCE = 0
    SWING = 1


class Controlword:
    """CiA 402 controlword (0x6040) values."""

    DISABLE_VOLTAGE = 0x0000
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE_OPERATION = 0x000F
    QUICK_STOP = 0x0002
    FAULT_RESET = 0x0080


class Statusword:
    """CiA 402 statusword (0x6041): state under MASK."""

    MASK = 0x006F
    NOT_READY = 0x0000
    SWITCH_ON_DISABLED = 0x0040
    READY_TO_SWITCH_ON = 0x0021
    SWITCHED_ON = 0x0023
    OPERATION_ENABLED = 0x0027
    QUICK_STOP_ACTIVE = 0x0007
    FAULT_REACTION_ACTIVE = 0x000F
    FAULT = 0x0008
    FOOT_CONTACT = 0x4000  # manufacturer-specific bit 14: the foot switch is closed
    LIMITED = 0x0800  # bit 11: internal limit active (current, torque, rate or position)


class NmtState:
    """States of a CANopen node (CiA 301), as its heartbeat tells them."""

    INITIALISING = 0x00  # as heartbeat: the boot-up message
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand:
    """What an NMT master may order."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class State(NamedTuple):
    """A drive's state, sent at every report (TPDO1, 24 bytes). SI units."""

    counter: int  # sample number, modulo 2**16
    statusword: int
    position: float  # rad, joint side
    velocity: float  # rad/s, joint side
    torque: float  # N m, sensed in the spring
    current: float  # A
    motor_velocity: float  # rad/s, motor as seen from the joint
    command_counter: int  # counter of the command in force, modulo 2**16
    error: int  # the fault in force: a number of ``bus.drive_faults.DriveFault``
    temperature: int  # °C


class Setpoint(NamedTuple):
    """One drive's slot in the command frame. SI units."""

    controlword: int = Controlword.DISABLE_VOLTAGE
    mode: int = Mode.NONE
    gain_set: int = GainSet.STANCE
    torque: float = 0.0  # N m
    position: float = 0.0  # rad
    velocity: float = 0.0  # rad/s
    torque_limit: float = 500.0  # N m
    state_counter: int = 0  # sample that this set-point was computed from


# The fields in the order of the tuples above, as struct codes.
STATE_LAYOUT = "HHiiihhHBB"
COMMAND_HEADER_LAYOUT = "HH"  # counter, reserved
SLOT_LAYOUT = "HbBiiiHH"
_STATE = struct.Struct("<" + STATE_LAYOUT)
_COMMAND_HEADER = struct.Struct("<" + COMMAND_HEADER_LAYOUT)
_ONE_SLOT = struct.Struct("<" + SLOT_LAYOUT)
_make_state = State._make
_make_setpoint = Setpoint._make
Slot = tuple[int, int, int, float, float, float, float, int]  # a Setpoint, or what one is made of
STATE_LENGTH = _STATE.size
COMMAND_LENGTH = _COMMAND_HEADER.size + SLOTS * _ONE_SLOT.size
assert STATE_LENGTH == 24 and COMMAND_LENGTH == 64
_COMMANDS = [
    struct.Struct(f"<{COMMAND_HEADER_LAYOUT}{used * SLOT_LAYOUT}{(SLOTS - used) * _ONE_SLOT.size}x")
    for used in range(SLOTS + 1)
]

_I32 = 2**31 - 1
_I16 = 2**15 - 1
_U16 = 2**16 - 1


class MalformedMessageError(ValueError):
    """A payload that is not of its message's length."""


def _fixed(value: float, scale: float, limit: int) -> int:
    """``value`` in counts, saturated: a drive that reads a wrapped number would do the opposite of what was
    meant. Raises ValueError for NaN."""
    if math.isinf(value):
        return limit if value > 0 else -limit
    return min(max(round(value / scale), -limit), limit)


def encode_state(s: State) -> bytes:
    """The 24 bytes of a TPDO1. Values beyond the range of their field saturate; NaN raises ValueError."""
    counter, statusword, position, velocity, torque, current, motor_velocity, command, error, temperature = s
    try:  # the rule: everything fits
        return _STATE.pack(
            counter & _U16, statusword & _U16,
            round(position / RADIAN), round(velocity / RADIAN_PER_SECOND), round(torque / NEWTON_METRE),
            round(current / AMPERE), round(motor_velocity / MOTOR_RADIAN_PER_SECOND),
            command & _U16, error & 0xFF, round(temperature),
        )  # fmt: skip
    except (struct.error, OverflowError):
        return _STATE.pack(
            counter & _U16, statusword & _U16,
            _fixed(position, RADIAN, _I32), _fixed(velocity, RADIAN_PER_SECOND, _I32),
            _fixed(torque, NEWTON_METRE, _I32),
            _fixed(current, AMPERE, _I16), _fixed(motor_velocity, MOTOR_RADIAN_PER_SECOND, _I16),
            command & _U16, error & 0xFF, max(_fixed(temperature, 1.0, 255), 0),
        )  # fmt: skip


def decode_state(data: bytes) -> State:
    """Read a TPDO1. Raises MalformedMessageError on a wrong length."""
    if len(data) != STATE_LENGTH:
        raise MalformedMessageError(f"drive state has {len(data)} bytes, not {STATE_LENGTH}")
    c, sw, q, dq, tau, i, dm, cc, e, temperature = _STATE.unpack(data)
    return _make_state(
        (c, sw, q * RADIAN, dq * RADIAN_PER_SECOND, tau * NEWTON_METRE, i * AMPERE,
         dm * MOTOR_RADIAN_PER_SECOND, cc, e, temperature)
    )  # fmt: skip


def _saturated(s: Slot) -> bytes:
    controlword, mode, gain_set, torque, position, velocity, torque_limit, state_counter = s
    return _ONE_SLOT.pack(
        controlword, mode, gain_set,
        _fixed(torque, NEWTON_METRE, _I32), _fixed(position, RADIAN, _I32), _fixed(velocity, RADIAN_PER_SECOND, _I32),
        max(_fixed(torque_limit, TORQUE_LIMIT, _U16), 0), state_counter & _U16,
    )  # fmt: skip


def encode_command(counter: int, setpoints: Sequence[Slot]) -> bytes:
    """The 64 bytes of a bus's command: one slot per drive in the bus's order, unused slots disabled.

    ``setpoints`` are Setpoints, or plain tuples of their fields. Values beyond the range of their field saturate; NaN
    raises ValueError. Raises MalformedMessageError for more set-points than slots.
    """
    if len(setpoints) > SLOTS:
        raise MalformedMessageError(f"{len(setpoints)} set-points do not fit into a command's {SLOTS} slots")
    fields = [counter & _U16, 0]
    try:  # the rule: everything fits
        for controlword, mode, gain_set, torque, position, velocity, torque_limit, state_counter in setpoints:
            fields += (
                controlword, mode, gain_set,
                round(torque / NEWTON_METRE), round(position / RADIAN), round(velocity / RADIAN_PER_SECOND),
                round(torque_limit / TORQUE_LIMIT), state_counter & _U16,
            )  # fmt: skip
        return _COMMANDS[len(setpoints)].pack(*fields)
    except (struct.error, OverflowError):
        slots = b"".join([_COMMAND_HEADER.pack(counter & _U16, 0), *map(_saturated, setpoints)])
        return slots.ljust(COMMAND_LENGTH, b"\0")


def command_counter(data: bytes) -> int:
    """Counter of a command frame, without decoding the slots. Raises MalformedMessageError on a wrong
    length."""
    if len(data) != COMMAND_LENGTH:
        raise MalformedMessageError(f"command has {len(data)} bytes, not {COMMAND_LENGTH}")
    return data[0] | data[1] << 8


def decode_setpoint(data: bytes, slot: int) -> Setpoint:
    """One drive's slot of a command frame. Raises MalformedMessageError on a wrong length."""
    if len(data) != COMMAND_LENGTH:
        raise MalformedMessageError(f"command has {len(data)} bytes, not {COMMAND_LENGTH}")
    at = _COMMAND_HEADER.size + _ONE_SLOT.size * slot
    cw, mode, gains, tau, q, dq, limit, counter = _ONE_SLOT.unpack_from(data, at)
    return _make_setpoint(
        (cw, mode, gains, tau * NEWTON_METRE, q * RADIAN, dq * RADIAN_PER_SECOND, limit * TORQUE_LIMIT,
         counter)
    )  # fmt: skip


def overwrite_torque(data: bytearray, slot: int, counts: int) -> None:
    """Put ``counts`` in the place of the torque of one slot of a command frame's bytes."""
    torque = struct.calcsize("<" + SLOT_LAYOUT[: Setpoint._fields.index("torque")])
    struct.pack_into("<i", data, _COMMAND_HEADER.size + _ONE_SLOT.size * slot + torque, counts)


def newer(counter: int, than: int) -> bool:
    """Whether 16-bit ``counter`` is ahead of ``than`` (serial number arithmetic, RFC 1982)."""
    return 0 < ((counter - than) & _U16) < 0x8000


EMERGENCY_LAYOUT = "HB5s"
_EMERGENCY = struct.Struct("<" + EMERGENCY_LAYOUT)
EMERGENCY_LENGTH = _EMERGENCY.size


def encode_emergency(error_code: int, register: int, detail: bytes = b"") -> bytes:
    """An EMCY payload (CiA 301): error code, error register, five bytes of the manufacturer's own."""
    return _EMERGENCY.pack(error_code, register, detail[:5])


def decode_emergency(data: bytes) -> tuple[int, int, bytes]:
    """Error code, register and detail of an EMCY payload. Raises MalformedMessageError on a wrong length."""
    if len(data) != EMERGENCY_LENGTH:
        raise MalformedMessageError(f"emergency has {len(data)} bytes, not {EMERGENCY_LENGTH}")
    return _EMERGENCY.unpack(data)
