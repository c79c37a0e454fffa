"""What a drive does about its faults (CiA 402): power off at once, or brake by the motor's velocity and then power off.

The choice is by what can still be trusted. Braking needs the motor's encoder, the measured current, the supply and an
interrupt that keeps its time; where one of these is what has failed, only zero current is safe.
"""

from __future__ import annotations

from enum import IntEnum

from bus.drive_faults import DriveFault


class Reaction(IntEnum):
    """Of the drive; a greater one overrules a lesser."""

    NONE = 0
    BRAKE = 1  # damped for the time of a quick stop, then power off
    POWER_OFF = 2


REACTIONS: dict[DriveFault, Reaction] = {
    DriveFault.MOTOR_ENCODER: Reaction.POWER_OFF,  # no velocity to brake by
    DriveFault.SPRING_ENCODER: Reaction.BRAKE,
    DriveFault.JOINT_ENCODER: Reaction.BRAKE,
    DriveFault.ENCODER_MISMATCH: Reaction.POWER_OFF,  # it may be the motor's encoder that is wrong
    DriveFault.CURRENT_SENSOR: Reaction.POWER_OFF,  # nothing limits the current
    DriveFault.SPRING: Reaction.POWER_OFF,  # braking the motor no longer brakes the joint
    DriveFault.UNDER_VOLTAGE: Reaction.POWER_OFF,  # the power stage may switch half
    DriveFault.OVER_VOLTAGE: Reaction.POWER_OFF,  # braking feeds back and raises it further
    DriveFault.OVER_CURRENT: Reaction.POWER_OFF,
    DriveFault.OVER_TORQUE: Reaction.POWER_OFF,  # a brake would hold what the spring cannot bear
    DriveFault.OVER_SPEED: Reaction.BRAKE,
    DriveFault.POSITION_LIMIT: Reaction.POWER_OFF,
    DriveFault.OVER_TEMPERATURE: Reaction.BRAKE,
    DriveFault.OVERLOAD: Reaction.BRAKE,
    DriveFault.COMMAND: Reaction.BRAKE,
    DriveFault.TIME_OVERRUN: Reaction.POWER_OFF,  # the velocity is a difference over a time that is unknown
    DriveFault.WATCHDOG: Reaction.BRAKE,
}

# While a drive brakes, whatever for, only these matter: what braking itself relies on. Others may follow from the
# first, as too much torque follows from a spring encoder that has jumped.
OF_BRAKING = (
    DriveFault.MOTOR_ENCODER, DriveFault.CURRENT_SENSOR, DriveFault.UNDER_VOLTAGE, DriveFault.OVER_VOLTAGE,
    DriveFault.OVER_CURRENT, DriveFault.TIME_OVERRUN,
)  # fmt: skip
BRAKING_MASK = sum(1 << fault for fault in OF_BRAKING)


def first(trips: int) -> DriveFault:
    """The fault that is told of a trip word: the lowest number."""
    return DriveFault((trips & -trips).bit_length() - 1)
