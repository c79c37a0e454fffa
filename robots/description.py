"""Reads a robot's description (``robots/NAME.toml``) into immutable objects that plant and controller build from."""

from __future__ import annotations

import tomllib
from functools import cached_property
from importlib import resources
from typing import Annotated, Self

from pydantic import Field, ValidationError, field_validator, model_validator

from robots.quantities import Config

Vector3 = Annotated[tuple[float, float, float], Field()]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class UnknownRobotError(ValueError):
    """No description of that name."""


class Link(Config):
    """A rigid link: mass [kg], centre of mass [m] and principal inertia about it [kg m²], both in the link frame."""

    mass: Positive
    com: Vector3
    inertia: Vector3

    @field_validator("inertia")
    @classmethod
    def _physical(cls, inertia: Vector3) -> Vector3:
        a, b, c = sorted(inertia)
        if a <= 0 or a + b < c:
            raise ValueError(f"inertia {inertia} is not that of a rigid body (positive, triangle inequality)")
        return inertia


class Base(Link):
    name: str


class Actuator(Config):
    """A series elastic actuator, all seen from the joint except gear_ratio, torque_constant and current_limit."""

    stiffness: Positive  # N m/rad
    damping: NonNegative  # N m s/rad, of the spring
    rotor_inertia: Positive  # kg m², reflected to the joint
    gear_ratio: Positive
    torque_constant: Positive  # N m/A at the motor
    current_limit: Positive  # A
    coulomb: NonNegative  # N m at the joint, sliding
    static: NonNegative  # N m at the joint, at rest
    load_friction: NonNegative  # share of the transmitted torque
    viscous: NonNegative  # N m s/rad at the joint

    @property
    def torque_per_ampere(self) -> float:
        """Motor torque at the joint per ampere, N m/A, without friction."""
        return self.gear_ratio * self.torque_constant


class JointSensor(Config):
    encoder: float  # motor encoder, counts per rad of the joint, signed
    torque_resolution: float  # N m per count of the spring encoder, signed
    torque_bias: NonNegative = 0.0  # N m, 1σ, of the spring encoder's zero
    current_bias: NonNegative = 0.0  # A, 1σ, of the current sensor's zero
    current_noise: NonNegative = 0.0  # A, 1σ per sample


class Joint(Config):
    """A revolute joint, the link behind it, and its drive."""

    name: str
    node_id: Annotated[int, Field(ge=1, le=127)]
    parent: str
    position: Vector3  # m, in the parent's frame
    axis: Vector3
    limits: tuple[float, float]  # rad
    link: Link
    actuator: Actuator
    sensor: JointSensor

    @property
    def spring_counts_per_rad(self) -> float:
        """Scale of the spring encoder, counts per rad of deflection, signed."""
        return self.actuator.stiffness / self.sensor.torque_resolution


class Foot(Config):
    name: str
    joint: str
    position: Vector3  # m, contact point's centre in the frame of the joint's link


class Bus(Config):
    name: str
    joints: tuple[str, ...]


class Imu(Config):
    """Torso IMU; noise densities are continuous-time (divide the square by the sample period for a variance)."""

    position: Vector3
    gyro_noise_density: NonNegative
    gyro_bias: NonNegative
    gyro_resolution: Positive
    accelerometer_noise_density: NonNegative
    accelerometer_bias: NonNegative
    accelerometer_resolution: Positive


class Robot(Config):
    """A whole robot: floating base, joints in the order of the generalised coordinates, feet, buses, IMU."""

    name: str
    gravity: Positive
    foot_radius: Positive
    base: Base
    joints: tuple[Joint, ...] = Field(alias="joint")
    feet: tuple[Foot, ...] = Field(alias="foot")
    buses: tuple[Bus, ...] = Field(alias="bus")
    imu: Imu

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        known = {self.base.name}
        for joint in self.joints:
            if joint.parent not in known:
                raise ValueError(f"joint {joint.name}: parent {joint.parent!r} is not defined before it")
            known.add(joint.name)
        on_buses = [name for bus in self.buses for name in bus.joints]
        if sorted(on_buses) != sorted(self.joint_names):
            raise ValueError("every joint must be on exactly one bus")
        return self

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return self.base.mass + sum(joint.link.mass for joint in self.joints)

    def joint(self, name: str) -> Joint:
        return self.joints[self.joint_names.index(name)]

    def joints_of(self, bus: Bus) -> tuple[Joint, ...]:
        return tuple(self.joint(name) for name in bus.joints)


def available() -> list[str]:
    """Names of the robots that have a description."""
    return sorted(f.name[:-5] for f in resources.files("robots").iterdir() if f.name.endswith(".toml"))


def load(name: str, variant: str | None = None) -> Robot:
    """The robot ``name``, with the masses of ``variant`` if one is named.

    Raises UnknownRobotError for a robot or variant without a description.
    """
    if name not in available():
        raise UnknownRobotError(f"no robot {name!r}; there is: {', '.join(available())}")
    data = tomllib.loads(resources.files("robots").joinpath(f"{name}.toml").read_text(encoding="utf-8"))
    variants = data.pop("variant", {})
    if variant is not None:
        if variant not in variants:
            raise UnknownRobotError(f"{name} has no variant {variant!r}; there is: {', '.join(variants) or 'none'}")
        for part, change in variants[variant].items():
            link = data["base"] if part == data["base"]["name"] else next(
                joint["link"] for joint in data["joint"] if joint["name"] == part
            )
            link.update(change)
    try:
        return Robot.model_validate(data)
    except ValidationError as error:
        raise UnknownRobotError(f"robots/{name}.toml: {error}") from None
