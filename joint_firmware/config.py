"""Configuration of a joint's firmware."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import AfterValidator, BeforeValidator, Field

from bus.messages import GainSet
from joint_firmware.protection_config import ProtectionConfig
from robots.description import Joint
from robots.quantities import (
    Config,
    Gain,
    Hertz,
    NewtonMetres,
    Probability,
    Radians,
    Seconds,
    SignedAmperes,
    TorquePerRadian,
    TorquePerRate,
    TorqueRate,
)

_Law = Literal["PD_f", "PD_m", "PID_m", "PD_m+DOB", "cascade", "valve"]  # joint_firmware.laws.TORQUE_LOOPS
LAW_NAMES: tuple[str, ...] = get_args(_Law)


def canonical_law(name: Any) -> Any:
    """``name`` as ``LAW_NAMES`` has it, whatever its case, ``_`` and spaces ("pdm+dob"); itself if it has none such."""
    if not isinstance(name, str):
        return name
    bare = {law.replace("_", "").lower(): law for law in LAW_NAMES}
    return bare.get(name.replace("_", "").replace(" ", "").lower(), name)


LawName = Annotated[_Law, BeforeValidator(canonical_law)]


class TorqueGains(Config):
    """Gains of the torque loop: motor torque per torque error, per its integral, and per motor velocity."""

    kp: Gain  # N m/(N m)
    ki: Gain = 0.0  # N m/(N m s)
    kd: TorquePerRate = 0.0  # N m s/rad at the joint


def _completed(by: TorqueGains) -> BeforeValidator:
    """A table that names some gains leaves the others as ``by`` has them."""
    written = {"kp": by.kp, "ki": by.ki, "kd": f"{by.kd!r} N m s/rad"}
    return BeforeValidator(lambda value: {**written, **value} if isinstance(value, dict) else value)


_STANCE = TorqueGains(kp=3.0, ki=0.0, kd="10 N m s/rad")  # type: ignore[arg-type]
_SWING = TorqueGains(kp=4.0, ki=20.0, kd="10 N m s/rad")  # type: ignore[arg-type]


class GainChange(Config):
    """What differs for one joint."""

    kp: Gain | None = None
    ki: Gain | None = None
    kd: TorquePerRate | None = None

    def of(self, gains: TorqueGains) -> TorqueGains:
        return gains.model_copy(update=self.model_dump(exclude_none=True))


class JointConfig(Config):
    """What one joint has of its own: gains where they are not those of all (Kim 2018 Tables 2.1, 7.1), calibration."""

    stance: GainChange = GainChange()
    swing: GainChange = GainChange()
    encoder_offset: Radians = 0.0  # what its absolute encoder reads at 0 rad


def _with_a_difference(joints: dict[str, JointConfig]) -> dict[str, JointConfig]:
    return {name: own for name, own in joints.items() if own != JointConfig()}


JointConfigs = Annotated[dict[str, JointConfig], AfterValidator(_with_a_difference)]


class FirmwareConfig(Config):
    """One set for all drives of a robot; what differs by joint is in ``joints`` and in its description."""

    rate: Hertz = 3000.0  # ISR rate
    report_rate: Hertz = 1500.0  # drive states per second
    boot_time: Seconds = 0.02
    heartbeat_period: Seconds = 0.1  # 0: none
    watchdog: Seconds = 0.005  # longest silence of the controller before a quick stop
    quick_stop_time: Seconds = 0.5  # damped for this long, then fault
    quick_stop_damping: TorquePerRate = 30.0
    law: LawName = "PID_m"  # torque loop
    velocity_estimator: Literal["filter", "M", "T", "M/T"] = "filter"  # joint_firmware.laws.velocity
    velocity_cutoff: Hertz = 200.0  # filter: first order, of differenced encoders
    velocity_window: Seconds = 0.002  # M, M/T: gate time
    stance: Annotated[TorqueGains, _completed(_STANCE)] = _STANCE
    swing: Annotated[TorqueGains, _completed(_SWING)] = _SWING
    joints: JointConfigs = Field(default_factory=dict)
    torque_rate_cutoff: Hertz = 60.0  # PD_f, valve: of the sensed torque's derivative; not printed in Kim 2018
    observer_cutoff: Hertz = 15.0  # PD_m+DOB: Kim 2018 §5.3.2
    velocity_integral: Gain = 20.0  # cascade, 1/s: integral over proportional gain of the inner velocity loop
    velocity_compensation: Probability = 0.0  # valve: share of the piston's flow that is fed forward
    valve_bias: SignedAmperes = 0.0  # valve: against its mechanical offset
    torque_limit: NewtonMetres = 150.0
    torque_rate: TorqueRate = 20000.0
    position_stiffness: TorquePerRadian = 300.0  # of the motor: cyclic synchronous position, motor position
    position_damping: TorquePerRate = 10.0
    joint_stiffness: TorquePerRadian = 100.0  # of the joint in joint position, around the torque loop
    joint_damping: TorquePerRate = 5.0
    impedance_stiffness: TorquePerRadian = 30.0  # of the joint in impedance
    impedance_damping: TorquePerRate = 3.0
    soft_stop_stiffness: Gain = 200.0  # N m/rad beyond a joint limit
    protection: ProtectionConfig = ProtectionConfig()

    def of_joint(self, name: str) -> FirmwareConfig:
        """That of one joint's drive."""
        own = self.joints.get(name, JointConfig())
        return self.model_copy(
            update={"joints": {}, "stance": own.stance.of(self.stance), "swing": own.swing.of(self.swing)}
        )


class Settings(NamedTuple):
    """What a master can change in a drive. It is lost with the drive's power."""

    config: FirmwareConfig
    joint: Joint
    motor_offset: float = 0.0  # rad
    spring_offset: float = 0.0  # rad
    joint_offset: float = 0.0  # rad
    gain_set: int = GainSet.STANCE  # while no command frame names one
