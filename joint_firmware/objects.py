"""The objects of a drive: communication (CiA 301), device (CiA 402), and what is this drive's own (0x2000 on).

Types and units of CiA 402 where it fixes them: torques and currents in thousandths of the rated ones (0x6076,
0x6075). Positions and velocities in the counts of ``bus.messages``. Own parameters are REAL32 in SI units; 0x2100 and
0x2200 are the fields of the drive's PDOs, from the layouts in ``bus.messages``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import annotated_types

from bus import messages
from bus.drive_faults import DriveFault
from bus.messages import GainSet, Mode, Setpoint, State
from joint_firmware.config import FirmwareConfig, TorqueGains
from joint_firmware.object_dictionary import (
    DataType,
    Object,
    ObjectDictionary,
    ObjectType,
    Variable,
    data_type,
    record,
    variable,
)
from joint_firmware.protection_config import ProtectionConfig
from robots.description import Joint, Robot

HISTORY = 8  # errors that 0x1003 remembers
PER_MILLE = 1000
_TURN = 6.3  # rad
_U8, _U16, _U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
_I8, _I16, _I32, _F32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32, DataType.REAL32
_TEXT = DataType.VISIBLE_STRING

# what a command frame's slot holds for a drive, behind the frame's counter; the drive has no use for the last field
COMMAND_FIELDS = ("counter", *Setpoint._fields[:-1])
_COMMAND_LAYOUT = messages.COMMAND_HEADER_LAYOUT[0] + messages.SLOT_LAYOUT[:-1]
_TPDO_OBJECTS = {"statusword": 0x6041, "position": 0x6064, "velocity": 0x606C}  # the others are in 0x2100


def rated_torque(config: FirmwareConfig) -> float:
    """What 1000 ‰ of torque are, N m: the configured limit, to the millinewtonmetre."""
    return max(round(config.torque_limit * 1e3), 1) * 1e-3


def rated_current(joint: Joint) -> float:
    """What 1000 ‰ of current are, A: the power stage's limit, to the milliampere."""
    return max(round(joint.actuator.current_limit * 1e3), 1) * 1e-3


def drive_dictionary(robot: Robot, joint: Joint, config: FirmwareConfig) -> ObjectDictionary:
    """The dictionary of ``joint``'s drive; what is not a constant nobody answers for yet."""
    config = config.of_joint(joint.name)
    slot = next(bus.joints.index(joint.name) for bus in robot.buses if joint.name in bus.joints)
    objects = [*_communication(robot.name, joint, slot, config), *_own(joint, config), *_device(joint, config)]
    return ObjectDictionary(objects, joint.node_id)


def _constant(name: str, kind: DataType, value: int | str, **more: object) -> Variable:
    return Variable(name, kind, "const", value, **more)  # type: ignore[arg-type]


def _fixed(name: str, value: int, per_node: bool = False) -> Variable:
    return Variable(name, _U32, "ro", value, per_node=per_node)


def _communication(robot: str, joint: Joint, slot: int, config: FirmwareConfig) -> Iterator[Object]:
    yield variable(0x1000, _constant("Device type", _U32, 0x00020192))  # servo drive of CiA 402
    yield variable(0x1001, Variable("Error register", _U8, mappable=True))
    errors = [Variable(f"Standard error field {n}", _U32) for n in range(1, HISTORY + 1)]
    history = record(0x1003, "Pre-defined error field", errors, ObjectType.ARRAY)
    history.variables[0] = Variable("Number of errors", _U8, "rw", low=0, high=0)  # 0 clears it
    yield history
    yield variable(0x1005, _fixed("COB-ID SYNC", messages.SYNC))
    yield variable(0x1008, _constant("Manufacturer device name", _TEXT, f"{robot} {joint.name}"))
    yield variable(0x1009, _constant("Manufacturer hardware version", _TEXT, "emulated"))
    yield variable(0x100A, _constant("Manufacturer software version", _TEXT, "1"))
    yield variable(0x1014, _fixed("COB-ID EMCY", messages.EMERGENCY, per_node=True))
    period = min(round(config.heartbeat_period * 1e3), 0xFFFF)
    yield variable(0x1017, Variable("Producer heartbeat time", _U16, "rw", period, unit="ms"))
    # a vendor id is CiA's to give: 0 is nobody's
    names = ("Vendor-ID", "Product code", "Revision number", "Serial number")
    values = (0, 1, 0x00010000, joint.node_id)
    identity = [Variable(n, _U32, "ro", v) for n, v in zip(names, values, strict=True)]
    yield record(0x1018, "Identity object", identity)
    yield variable(0x1021, Variable("Store EDS", DataType.DOMAIN))
    yield variable(0x1022, _constant("Store format", _U16, 0))  # plain ASCII
    yield record(0x1200, "SDO server parameter", [
        _fixed("COB-ID client to server", messages.SDO_REQUEST, per_node=True),
        _fixed("COB-ID server to client", messages.SDO_RESPONSE, per_node=True),
    ])  # fmt: skip
    yield record(0x1400, "RPDO communication parameter 1", [
        _fixed("COB-ID used by RPDO", messages.COMMAND),
        Variable("Transmission type", _U8, "ro", 255),
    ])  # fmt: skip
    yield record(0x1600, "RPDO mapping parameter 1", _mapping(_rpdo(slot)))
    yield record(0x1800, "TPDO communication parameter 1", [
        _fixed("COB-ID used by TPDO", messages.STATE | 1 << 30, per_node=True),  # bit 30: no remote request
        Variable("Transmission type", _U8, "rw", 255),
    ])  # fmt: skip
    yield record(0x1A00, "TPDO mapping parameter 1", _mapping(_tpdo()))
    yield variable(0x1F80, _constant("NMT startup", _U32, 0))  # bit 2 clear: goes to operational by itself


def _mapping(entries: list[tuple[int, int, int]]) -> list[Variable]:
    return [
        _fixed(f"Mapped object {n}", index << 16 | sub << 8 | bits)
        for n, (index, sub, bits) in enumerate(entries, start=1)
    ]


def _tpdo() -> list[tuple[int, int, int]]:
    """Index, sub-index, bits of what the state frame holds."""
    entries = []
    for n, (name, code) in enumerate(zip(State._fields, messages.STATE_LAYOUT, strict=True), start=1):
        index = _TPDO_OBJECTS.get(name)
        entries.append((index or 0x2100, 0 if index else n, 8 * struct.calcsize("<" + code)))
    return entries


def _rpdo(slot: int) -> list[tuple[int, int, int]]:
    """The command frame as the drive in ``slot`` reads it: dummy objects (0x0006, 0x0007) pass over the rest."""
    bits = [8 * struct.calcsize("<" + code) for code in _COMMAND_LAYOUT]
    words = struct.calcsize("<" + messages.SLOT_LAYOUT) // 4
    word, half = (int(_U32), 0, 32), (int(_U16), 0, 16)
    own = [(0x2200, n, size) for n, size in enumerate(bits, start=1)]
    others_before, others_behind = slot * words * [word], (messages.SLOTS - 1 - slot) * words * [word]
    return [own[0], half, *others_before, *own[1:], half, *others_behind]


def _fields(names: tuple[str, ...], layout: str) -> list[Variable]:
    return [
        Variable(name, data_type(code), unit=messages.UNITS.get(name, (1.0, ""))[1],
                 factor=messages.UNITS.get(name, (1.0, ""))[0], mappable=True)
        for name, code in zip(names, layout, strict=True)
    ]  # fmt: skip


def _parameter(name: str, default: float, low: float, high: float, unit: str = "") -> Variable:
    """A REAL32 that may be written; a configuration beyond the usual range is its own bound."""
    return Variable(name, _F32, "rw", default, min(low, default), max(high, default), unit)


def _gains(index: int, name: str, gains: TorqueGains) -> Object:
    return record(index, name, [
        _parameter("kp", gains.kp, 0.0, 100.0),
        _parameter("ki", gains.ki, 0.0, 1e4, "1/s"),
        _parameter("kd", gains.kd, 0.0, 1e3, "N m s/rad"),
    ])  # fmt: skip


def _supported_modes() -> int:
    """0x6502: bit n − 1 is mode n of CiA 402, bit 15 + n the manufacturer's mode −n."""
    numbers = [number for name, number in vars(Mode).items() if name.isupper() and number != Mode.NONE]
    return sum(1 << (n - 1 if n > 0 else 15 - n) for n in numbers)


def _scale(name: str, counts_per_rad: float) -> Variable:
    """A calibrated scale: within a factor of two, and never with the other sign, which would turn the loop over."""
    low, high = sorted((0.5 * counts_per_rad, 2.0 * counts_per_rad))
    return Variable(name, _F32, "rw", counts_per_rad, low, high, "1/rad")


def protection_limits() -> list[str]:
    """Fields of ``ProtectionConfig`` in the order of the sub-indices of 0x2040."""
    return list(ProtectionConfig.model_fields)


def _limits(config: ProtectionConfig) -> list[Variable]:
    limits = []
    for name, field in ProtectionConfig.model_fields.items():
        low = max(m.ge for m in field.metadata if isinstance(m, annotated_types.Ge))  # type: ignore[type-var]
        high = min(m.le for m in field.metadata if isinstance(m, annotated_types.Le))  # type: ignore[type-var]
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        text = name.replace("_", " ").capitalize()
        limits.append(_parameter(text, getattr(config, name), low, high, str(extra.get("unit", ""))))  # type: ignore[arg-type]
    return limits


def _own(joint: Joint, config: FirmwareConfig) -> Iterator[Object]:
    yield _gains(0x2000, "Torque gains, stance", config.stance)
    yield _gains(0x2001, "Torque gains, swing", config.swing)
    yield variable(0x2002, Variable("Gain set without PDO", _U8, "rw", GainSet.STANCE, 0, 1))
    yield record(0x2003, "Control law", [
        _constant("Torque loop", _TEXT, config.law),
        _constant("Velocity estimator", _TEXT, config.velocity_estimator),
    ])  # fmt: skip
    yield variable(0x2010, _parameter("Command watchdog", config.watchdog, 1e-3, 1.0, "s"))
    yield variable(0x2011, _parameter("Torque rate limit", config.torque_rate, 1.0, 1e6, "N m/s"))
    yield variable(0x2012, _parameter("Soft stop stiffness", config.soft_stop_stiffness, 0.0, 1e4, "N m/rad"))
    yield variable(0x2013, _parameter("Quick stop damping", config.quick_stop_damping, 0.0, 1e3, "N m s/rad"))
    yield variable(0x2014, _parameter("Position stiffness", config.position_stiffness, 0.0, 1e4, "N m/rad"))
    yield variable(0x2015, _parameter("Position damping", config.position_damping, 0.0, 1e3, "N m s/rad"))
    yield variable(0x2016, _parameter("Joint stiffness", config.joint_stiffness, 0.0, 1e4, "N m/rad"))
    yield variable(0x2017, _parameter("Joint damping", config.joint_damping, 0.0, 1e3, "N m s/rad"))
    yield variable(0x2018, _parameter("Impedance stiffness", config.impedance_stiffness, 0.0, 1e4, "N m/rad"))
    yield variable(0x2019, _parameter("Impedance damping", config.impedance_damping, 0.0, 1e3, "N m s/rad"))
    fastest = 0.4 * config.rate
    yield variable(0x201A, _parameter("Torque rate cutoff", config.torque_rate_cutoff, 0.1, fastest, "Hz"))
    yield variable(0x201B, _parameter("Observer cutoff", config.observer_cutoff, 0.1, fastest, "Hz"))
    yield variable(0x201C, _parameter("Velocity integral", config.velocity_integral, 0.0, 1e4, "1/s"))
    yield variable(0x201D, _parameter("Velocity compensation", config.velocity_compensation, 0.0, 1.0))
    bias = joint.actuator.current_limit
    yield variable(0x201E, _parameter("Valve bias", config.valve_bias, -bias, bias, "A"))
    yield record(0x2020, "Calibration", [
        _scale("Motor encoder scale", joint.sensor.encoder),
        _parameter("Motor encoder offset", 0.0, -_TURN, _TURN, "rad"),
        _scale("Spring encoder scale", joint.spring_counts_per_rad),
        _parameter("Spring encoder offset", 0.0, -0.1, 0.1, "rad"),
        Variable("Spring stiffness", _F32, "ro", joint.actuator.stiffness, unit="N m/rad"),
        _parameter("Joint encoder offset", 0.0, -_TURN, _TURN, "rad"),
        Variable("Joint encoder reading", _F32, "ro", unit="rad"),
    ])  # fmt: skip
    yield record(0x2030, "Interrupt counters", [Variable("Ticks", _U32), Variable("Malformed frames", _U32)])
    yield record(0x2040, "Protection limits", _limits(config.protection))
    yield record(0x2041, "Protection levels", [
        Variable(fault.name.replace("_", " ").capitalize(), _F32) for fault in DriveFault if fault
    ])  # fmt: skip
    yield record(0x2042, "Protection state", [Variable("Trip word", _U32), Variable("Fault", _U8)])
    yield record(0x2100, "State", _fields(State._fields, messages.STATE_LAYOUT))
    yield record(0x2200, "Command in force", _fields(COMMAND_FIELDS, _COMMAND_LAYOUT))


def _device(joint: Joint, config: FirmwareConfig) -> Iterator[Object]:
    low, high = (round(limit / messages.RADIAN) for limit in joint.limits)
    position = {"unit": "rad", "factor": messages.RADIAN}
    torque = {"unit": "N m", "factor": rated_torque(config) / PER_MILLE}
    yield variable(0x603F, Variable("Error code", _U16, mappable=True))
    yield variable(0x6040, Variable("Controlword", _U16, "rw"))
    yield variable(0x6041, Variable("Statusword", _U16, mappable=True))
    yield variable(0x605A, _constant("Quick stop option code", _I16, -1))  # own: motor damping, then switched off
    yield variable(0x605E, _constant("Fault reaction option code", _I16, -1))  # own: by fault
    yield variable(0x6060, Variable("Modes of operation", _I8, "rw"))
    yield variable(0x6061, Variable("Modes of operation display", _I8, mappable=True))
    yield variable(0x6064, Variable("Position actual value", _I32, mappable=True, **position))  # type: ignore[arg-type]
    yield variable(0x606C, Variable("Velocity actual value", _I32, unit="rad/s", factor=messages.RADIAN_PER_SECOND,
                                    mappable=True))  # fmt: skip
    yield variable(0x6071, Variable("Target torque", _I16, "rw", None, -PER_MILLE, PER_MILLE, **torque))  # type: ignore[arg-type]
    yield variable(0x6072, Variable("Max torque", _U16, "rw", PER_MILLE, 0, PER_MILLE, **torque))  # type: ignore[arg-type]
    yield variable(0x6074, Variable("Torque demand", _I16, mappable=True, **torque))  # type: ignore[arg-type]
    current = round(rated_current(joint) * 1e3)
    yield variable(0x6075, _constant("Motor rated current", _U32, current, unit="A", factor=1e-3))
    rated = round(rated_torque(config) * 1e3)
    yield variable(0x6076, _constant("Motor rated torque", _U32, rated, unit="N m", factor=1e-3))
    yield variable(0x6077, Variable("Torque actual value", _I16, mappable=True, **torque))  # type: ignore[arg-type]
    yield variable(0x6078, Variable("Current actual value", _I16, unit="A", factor=current / 1e3 / PER_MILLE,
                                    mappable=True))  # fmt: skip
    yield variable(0x6079, Variable("DC link circuit voltage", _U32, unit="V", factor=1e-3, mappable=True))
    yield variable(0x607A, Variable("Target position", _I32, "rw", None, low, high, **position))  # type: ignore[arg-type]
    yield record(0x607D, "Software position limit", [
        Variable("Min position limit", _I32, "rw", low, low, high, **position),  # type: ignore[arg-type]
        Variable("Max position limit", _I32, "rw", high, low, high, **position),  # type: ignore[arg-type]
    ], ObjectType.ARRAY)  # fmt: skip
    yield variable(0x6502, _constant("Supported drive modes", _U32, _supported_modes()))
