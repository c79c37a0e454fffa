"""The DBC file of a robot's bus, from the layouts of ``bus.messages``."""

from __future__ import annotations

from bus import messages
from bus.messages import Controlword, Mode, Statusword
from robots.description import Bus, Robot

# name, start bit, bits, signed, scale, unit
_STATE = (
    ("counter", 0, 16, False, 1, ""),
    ("statusword", 16, 16, False, 1, ""),
    ("position", 32, 32, True, messages.RADIAN, "rad"),
    ("velocity", 64, 32, True, messages.RADIAN_PER_SECOND, "rad/s"),
    ("torque", 96, 32, True, messages.NEWTON_METRE, "N m"),
    ("current", 128, 16, True, messages.AMPERE, "A"),
    ("motor_velocity", 144, 16, True, 1e-3, "rad/s"),
    ("command_counter", 160, 16, False, 1, ""),
    ("error", 176, 8, False, 1, ""),
    ("temperature", 184, 8, False, 1, "degC"),
)
_SLOT = (
    ("controlword", 0, 16, False, 1, ""),
    ("mode", 16, 8, True, 1, ""),
    ("gain_set", 24, 8, False, 1, ""),
    ("torque", 32, 32, True, messages.NEWTON_METRE, "N m"),
    ("position", 64, 32, True, messages.RADIAN, "rad"),
    ("velocity", 96, 32, True, messages.RADIAN_PER_SECOND, "rad/s"),
    ("torque_limit", 128, 16, False, messages.TORQUE_LIMIT, "N m"),
    ("state_counter", 144, 16, False, 1, ""),
)
_HEADER = 32  # bits before the first slot
_SLOT_BITS = 160


def _signal(name: str, start: int, bits: int, signed: bool, scale: float, unit: str, receiver: str) -> str:
    return f' SG_ {name} : {start}|{bits}@1{"-" if signed else "+"} ({scale:g},0) [0|0] "{unit}" {receiver}'


def dbc(robot: Robot, bus: Bus) -> str:
    """Text of the DBC file of ``bus``: drive states, command, heartbeats, emergencies."""
    joints = robot.joints_of(bus)
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: gateway " + " ".join(j.name for j in joints), ""]
    values: list[str] = []
    identifiers: list[int] = []

    def message(identifier: int, name: str, length: int, sender: str, signals: list[str]) -> None:
        identifiers.append(identifier)
        lines.append(f"BO_ {identifier} {name}: {length} {sender}")
        lines.extend(signals)
        lines.append("")

    def table(identifier: int, signal: str, names: type) -> None:
        entries = [(value, key) for key, value in vars(names).items() if key.isupper() and key not in ("MASK",)]
        text = " ".join(f'{value} "{key}"' for value, key in entries)
        values.append(f"VAL_ {identifier} {signal} {text} ;")

    command = [_signal("counter", 0, 16, False, 1, "", joints[0].name)]
    for slot, joint in enumerate(joints):
        for name, start, bits, signed, scale, unit in _SLOT:
            at = _HEADER + slot * _SLOT_BITS + start
            command.append(_signal(f"{joint.name}_{name}", at, bits, signed, scale, unit, joint.name))
    message(messages.COMMAND, "command", messages.COMMAND_LENGTH, "gateway", command)
    for joint in joints:
        table(messages.COMMAND, f"{joint.name}_controlword", Controlword)
        table(messages.COMMAND, f"{joint.name}_mode", Mode)
    for joint in joints:
        state = [_signal(*field, "gateway") for field in _STATE]
        identifier = messages.STATE + joint.node_id
        message(identifier, f"{joint.name}_state", messages.STATE_LENGTH, joint.name, state)
        table(identifier, "statusword", Statusword)
        beat = [_signal("nmt_state", 0, 8, False, 1, "", "gateway")]
        message(messages.HEARTBEAT + joint.node_id, f"{joint.name}_heartbeat", 1, joint.name, beat)
        emergency = [
            _signal("error_code", 0, 16, False, 1, "", "gateway"),
            _signal("error_register", 16, 8, False, 1, "", "gateway"),
        ]
        message(messages.EMERGENCY + joint.node_id, f"{joint.name}_emergency", 8, joint.name, emergency)
    lines += [
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG","reserved","reserved",'
        '"reserved","reserved","reserved","reserved","reserved","reserved","reserved","reserved","StandardCAN_FD",'
        '"ExtendedCAN_FD";',
        'BA_DEF_ "BusType" STRING ;',
        'BA_DEF_DEF_ "VFrameFormat" "StandardCAN_FD";',
        'BA_DEF_DEF_ "BusType" "CAN FD";',
        'BA_ "BusType" "CAN FD";',
        *[f'BA_ "VFrameFormat" BO_ {identifier} 14;' for identifier in identifiers],
        *values,
        "",
    ]
    return "\n".join(lines)
