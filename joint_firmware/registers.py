"""Objects of the dictionary and the drive's registers, connected: what is read is what is in force."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from bus import messages
from bus.drive_faults import DriveFault
from joint_firmware import objects
from joint_firmware.config import FirmwareConfig
from joint_firmware.eds import eds
from joint_firmware.laws import doubts
from joint_firmware.laws import signals as law
from joint_firmware.object_dictionary import AbortCode, ObjectDictionary, SdoAbort
from robots import pins

if TYPE_CHECKING:
    from joint_firmware.firmware import JointFirmware

_MILLI = 1e3
_COUNTER = 0xFFFFFFFF
_STATE = struct.Struct("<" + messages.STATE_LAYOUT)


def connect(dictionary: ObjectDictionary, drive: JointFirmware) -> None:
    """Let ``drive`` answer for every object that is not its communication's."""
    _device(dictionary, drive)
    _parameters(dictionary, drive)
    text: list[bytes] = []  # written once, when somebody asks

    def data_sheet() -> bytes:
        if not text:
            text.append(eds(dictionary).encode("ascii", "replace"))
        return text[0]

    dictionary.connect(0x1021, 0, data_sheet)
    dictionary.connect(0x2030, 1, lambda: drive.ticks & _COUNTER)
    dictionary.connect(0x2030, 2, lambda: drive.malformed & _COUNTER)
    _protection(dictionary, drive)
    for n in range(len(messages.STATE_LAYOUT)):
        dictionary.connect(0x2100, n + 1, lambda n=n: _state(drive)[n])  # type: ignore[misc]
    for n, field in enumerate(objects.COMMAND_FIELDS, start=1):
        dictionary.connect(0x2200, n, _command_field(drive, field))


def _state(drive: JointFirmware) -> tuple[int, ...]:
    """The fields of a report, in counts."""
    return _STATE.unpack(drive.report(drive.ticks))


def _command_field(drive: JointFirmware, field: str) -> Callable[[], Any]:
    inputs = {"torque": law.U_TORQUE, "position": law.U_POSITION, "velocity": law.U_VELOCITY,
              "torque_limit": law.U_LIMIT}  # fmt: skip
    if field in inputs:
        scale = messages.UNITS[field][0]
        return lambda: drive.u[inputs[field]] / scale
    return lambda: getattr(drive, field)


def _device(dictionary: ObjectDictionary, drive: JointFirmware) -> None:
    """CiA 402."""
    per_newton_metre = objects.PER_MILLE / objects.rated_torque(drive.settings.config)
    per_ampere = objects.PER_MILLE / objects.rated_current(drive.settings.joint)
    u, y, x = drive.u, drive.y, drive.x

    def write_target_torque(value: float) -> None:
        drive.set_target(torque=value / per_newton_metre)

    def write_target_position(value: float) -> None:
        drive.set_target(position=value * messages.RADIAN)

    def write_max_torque(value: float) -> None:
        limit = value / per_newton_metre
        drive.configure(config=drive.settings.config.model_copy(update={"torque_limit": limit}))

    def write_limit(end: int, value: float) -> None:
        limits = list(drive.settings.joint.limits)
        limits[end] = value * messages.RADIAN
        if limits[0] > limits[1]:
            raise SdoAbort(AbortCode.MAXIMUM_BELOW_MINIMUM)
        drive.configure(joint=drive.settings.joint.model_copy(update={"limits": tuple(limits)}))

    reference = drive.law.states.index("torque_reference")
    place = dictionary.connect
    place(0x603F, 0, lambda: drive.error)
    place(0x6040, 0, lambda: drive.controlword, drive.set_controlword)
    place(0x6041, 0, lambda: _state(drive)[1])
    place(0x6060, 0, lambda: drive.mode, drive.set_mode)
    place(0x6061, 0, lambda: drive.mode)
    place(0x6064, 0, lambda: y[law.Y_POSITION])
    place(0x606C, 0, lambda: y[law.Y_VELOCITY])
    place(0x6071, 0, lambda: u[law.U_TORQUE] * per_newton_metre, write_target_torque)
    place(0x6072, 0, lambda: drive.settings.config.torque_limit * per_newton_metre, write_max_torque)
    place(0x6074, 0, lambda: x[reference] * per_newton_metre)
    place(0x6077, 0, lambda: y[law.Y_TORQUE_SI] * per_newton_metre)
    place(0x6078, 0, lambda: y[law.Y_CURRENT] * messages.AMPERE * per_ampere)
    place(0x6079, 0, lambda: drive.pin(pins.SUPPLY_ADC) * pins.VOLT_PER_COUNT * _MILLI)
    place(0x607A, 0, lambda: u[law.U_POSITION] / messages.RADIAN, write_target_position)
    for end in (0, 1):
        place(
            0x607D, end + 1,
            lambda end=end: drive.settings.joint.limits[end] / messages.RADIAN,  # type: ignore[misc]
            lambda value, end=end: write_limit(end, value),  # type: ignore[misc]
        )  # fmt: skip


def _protection(dictionary: ObjectDictionary, drive: JointFirmware) -> None:
    """Limits of the monitors, how much of them is used, and what has tripped."""

    def limit(sub: int, name: str) -> None:
        def write(value: float) -> None:
            config = drive.settings.config
            limits = config.protection.model_copy(update={name: value})
            drive.configure(config=config.model_copy(update={"protection": limits}))

        dictionary.connect(0x2040, sub, lambda: getattr(drive.settings.config.protection, name), write)

    for sub, name in enumerate(objects.protection_limits(), start=1):
        limit(sub, name)
    for fault in DriveFault:
        if fault:
            dictionary.connect(0x2041, fault, lambda fault=fault: drive.levels()[fault - 1])  # type: ignore[misc]
    dictionary.connect(0x2042, 1, lambda: int(drive.y[law.Y_TRIPS]))
    dictionary.connect(0x2042, 2, lambda: drive.fault)


def _parameters(dictionary: ObjectDictionary, drive: JointFirmware) -> None:
    """The drive's own parameters: each is a value of its settings."""

    def accept(config: FirmwareConfig) -> None:
        try:
            doubts(drive.settings.joint, config)
        except ValueError:  # unstable
            raise SdoAbort(AbortCode.VALUE) from None
        drive.configure(config=config)

    def gain(index: int, sub: int, which: str, name: str) -> None:
        def write(value: float) -> None:
            config = drive.settings.config
            gains = getattr(config, which).model_copy(update={name: value})
            accept(config.model_copy(update={which: gains}))

        dictionary.connect(index, sub, lambda: getattr(getattr(drive.settings.config, which), name), write)

    def parameter(index: int, name: str) -> None:
        def write(value: float) -> None:
            accept(drive.settings.config.model_copy(update={name: value}))

        dictionary.connect(index, 0, lambda: getattr(drive.settings.config, name), write)

    def calibration(sub: int, read: Callable[[], float], change: Callable[[float], dict[str, Any]]) -> None:
        def write(value: float) -> None:
            if drive.powered:
                raise SdoAbort(AbortCode.DEVICE_STATE)  # what is sensed would jump under the control law
            drive.configure(**change(value))

        dictionary.connect(0x2020, sub, read, write)

    def sensor(**update: float) -> dict[str, Any]:
        joint = drive.settings.joint
        return {"joint": joint.model_copy(update={"sensor": joint.sensor.model_copy(update=update)})}

    for sub, name in enumerate(("kp", "ki", "kd"), start=1):
        gain(0x2000, sub, "stance", name)
        gain(0x2001, sub, "swing", name)
    dictionary.connect(0x2002, 0, lambda: drive.settings.gain_set, lambda v: drive.configure(gain_set=int(v)))
    for index, name in enumerate(
        ("watchdog", "torque_rate", "soft_stop_stiffness", "quick_stop_damping", "position_stiffness",
         "position_damping", "joint_stiffness", "joint_damping", "impedance_stiffness", "impedance_damping",
         "torque_rate_cutoff", "observer_cutoff", "velocity_integral", "velocity_compensation", "valve_bias"),
        start=0x2010,
    ):  # fmt: skip
        parameter(index, name)
    calibration(1, lambda: drive.settings.joint.sensor.encoder, lambda v: sensor(encoder=v))
    calibration(2, lambda: drive.settings.motor_offset, lambda v: {"motor_offset": v})
    calibration(
        3, lambda: drive.settings.joint.spring_counts_per_rad,
        lambda v: sensor(torque_resolution=drive.settings.joint.actuator.stiffness / v),
    )  # fmt: skip
    calibration(4, lambda: drive.settings.spring_offset, lambda v: {"spring_offset": v})
    calibration(6, lambda: drive.settings.joint_offset, drive.recalibrated)
    dictionary.connect(
        0x2020, 7, lambda: drive.pin(pins.JOINT_ENCODER) / drive.settings.joint.sensor.joint_encoder
    )
