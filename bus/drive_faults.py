"""Faults of a drive: the number that its state carries, and what its emergency says.

Numbers go from causes to consequences: of several faults that a drive notices at once the lowest is told, a broken
encoder before the speed that it pretends. Bit ``1 << number`` of a drive's trip word is the fault that is present.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class DriveFault(IntEnum):
    """What a drive's protection has found; the number is the ``error`` of its state (TPDO1)."""

    NONE = 0
    MOTOR_ENCODER = 1
    SPRING_ENCODER = 2
    JOINT_ENCODER = 3
    ENCODER_MISMATCH = 4
    CURRENT_SENSOR = 5
    SPRING = 6
    UNDER_VOLTAGE = 7
    OVER_VOLTAGE = 8
    OVER_CURRENT = 9
    OVER_TORQUE = 10
    OVER_SPEED = 11
    POSITION_LIMIT = 12
    OVER_TEMPERATURE = 13
    OVERLOAD = 14
    COMMAND = 15
    TIME_OVERRUN = 16
    WATCHDOG = 17


class ErrorRegister:
    """Bits of the error register (CiA 301, object 0x1001)."""

    GENERIC = 0x01  # set with any error
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    PROFILE = 0x20  # what the device profile defines
    MANUFACTURER = 0x80


class Emergency(NamedTuple):
    """The error code of an emergency and its bit of the error register beside the generic one."""

    code: int
    register: int

    @property
    def registers(self) -> int:
        """The error register while this is the error in force."""
        return ErrorRegister.GENERIC | self.register if self.code else 0


# 0x8130, 0x6100: emergency error codes of CiA 301; all others: error codes of the drive profile CiA 402 (IEC 61800-7)
EMERGENCIES: dict[DriveFault, Emergency] = {
    DriveFault.NONE: Emergency(0x0000, 0),  # error reset, or no error
    DriveFault.MOTOR_ENCODER: Emergency(0x7305, ErrorRegister.PROFILE),  # incremental sensor 1 fault
    DriveFault.SPRING_ENCODER: Emergency(0x7306, ErrorRegister.PROFILE),  # incremental sensor 2 fault
    DriveFault.JOINT_ENCODER: Emergency(0x7320, ErrorRegister.PROFILE),  # position (sensor)
    DriveFault.ENCODER_MISMATCH: Emergency(0x7300, ErrorRegister.PROFILE),  # sensor
    DriveFault.CURRENT_SENSOR: Emergency(0x7200, ErrorRegister.CURRENT),  # measurement circuit
    DriveFault.SPRING: Emergency(0x8331, ErrorRegister.PROFILE),  # torque fault
    DriveFault.UNDER_VOLTAGE: Emergency(0x3220, ErrorRegister.VOLTAGE),  # DC link under-voltage
    DriveFault.OVER_VOLTAGE: Emergency(0x3210, ErrorRegister.VOLTAGE),  # DC link over-voltage
    DriveFault.OVER_CURRENT: Emergency(0x2310, ErrorRegister.CURRENT),  # continuous over current, output side
    DriveFault.OVER_TORQUE: Emergency(0x8311, ErrorRegister.PROFILE),  # excess torque
    DriveFault.OVER_SPEED: Emergency(0x8400, ErrorRegister.PROFILE),  # velocity (speed) controller
    DriveFault.POSITION_LIMIT: Emergency(0x8612, ErrorRegister.PROFILE),  # reference limit
    DriveFault.OVER_TEMPERATURE: Emergency(0x4310, ErrorRegister.TEMPERATURE),  # excess temperature, drive
    DriveFault.OVERLOAD: Emergency(0x2350, ErrorRegister.CURRENT),  # load level fault (I²t, thermal state)
    DriveFault.COMMAND: Emergency(0x8900, ErrorRegister.PROFILE),  # process data monitoring
    DriveFault.TIME_OVERRUN: Emergency(0x6100, ErrorRegister.MANUFACTURER),  # internal software
    DriveFault.WATCHDOG: Emergency(0x8130, ErrorRegister.COMMUNICATION),  # life guard or heartbeat
}
