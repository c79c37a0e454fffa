"""Configuration of a joint's firmware."""

from __future__ import annotations

from typing import Literal, NamedTuple

from bus.messages import GainSet
from joint_firmware.protection_config import ProtectionConfig
from robots.description import Joint
from robots.quantities import (
    Config,
    Gain,
    Hertz,
    NewtonMetres,
    Seconds,
    TorquePerRadian,
    TorquePerRate,
    TorqueRate,
)

# torque loops, one per entry of joint_firmware.laws.TORQUE_LOOPS
LawName = Literal["PD_m", "PID_m"]


class TorqueGains(Config):
    """Gains of the torque loop: motor torque per torque error, per its integral, and per motor velocity."""

    kp: Gain  # N m/(N m)
    ki: Gain = 0.0  # N m/(N m s)
    kd: TorquePerRate = 0.0  # N m s/rad at the joint


class FirmwareConfig(Config):
    """One set for all drives of a robot; what differs by joint (limits, scales) is in its description."""

    rate: Hertz = 3000.0  # ISR rate
    report_rate: Hertz = 1500.0  # drive states per second
    boot_time: Seconds = 0.02
    heartbeat_period: Seconds = 0.1  # 0: none
    watchdog: Seconds = 0.005  # longest silence of the controller before a quick stop
    quick_stop_time: Seconds = 0.5  # damped for this long, then fault
    quick_stop_damping: TorquePerRate = 30.0
    law: LawName = "PID_m"  # torque loop
    velocity_cutoff: Hertz = 200.0  # first-order filter of differenced encoders
    stance: TorqueGains = TorqueGains(kp=3.0, ki=0.0, kd="10 N m s/rad")  # type: ignore[arg-type]
    swing: TorqueGains = TorqueGains(kp=4.0, ki=20.0, kd="10 N m s/rad")  # type: ignore[arg-type]
    torque_limit: NewtonMetres = 150.0
    torque_rate: TorqueRate = 20000.0
    position_stiffness: TorquePerRadian = 300.0  # of the motor in cyclic synchronous position, around the torque loop
    position_damping: TorquePerRate = 10.0
    soft_stop_stiffness: Gain = 200.0  # N m/rad beyond a joint limit
    protection: ProtectionConfig = ProtectionConfig()


class Settings(NamedTuple):
    """What a master can change in a drive. It is lost with the drive's power."""

    config: FirmwareConfig
    joint: Joint
    motor_offset: float = 0.0  # rad
    spring_offset: float = 0.0  # rad
    gain_set: int = GainSet.STANCE  # while no command frame names one
