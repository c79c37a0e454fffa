"""Reads a robot's description (``robots/NAME.toml``) into immutable objects that plant and controller build from."""

from __future__ import annotations

import importlib.util
import math
import sys
import tomllib
from collections.abc import Mapping
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, ValidationError, field_validator, model_validator

from robots.actuators import BUILT_IN, Actuator, AnyActuator
from robots.quantities import Config

Vector3 = Annotated[tuple[float, float, float], Field()]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


# Absolute encoder of a joint, ASSUMED where no source tells: 16 bit per turn, between the 14 bit of RLS's Orbis and the
# 17 to 20 bit of their AksIM-2, encoders made for joints.
JOINT_ENCODER = 2**16 / (2 * math.pi)  # counts per rad


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


    def with_mass(self, factor: float) -> Self:
        """The same shape of another density."""
        return self.model_copy(
            update={"mass": factor * self.mass, "inertia": tuple(factor * moment for moment in self.inertia)}
        )


class Base(Link):
    name: str


class JointSensor(Config):
    """Sensors of a drive, in equivalent rotary coordinates (``robots.actuators``), if rotary those of the joint."""

    encoder: float  # motor encoder, counts per rad, signed
    torque_resolution: float  # N m per count of the spring encoder, signed
    joint_encoder: float = JOINT_ENCODER  # absolute, counts per rad of the joint, signed
    force_resolution: float = 0.0  # N m per count of the load cell, signed; 0: there is none
    torque_bias: NonNegative = 0.0  # N m, 1σ, of the spring encoder's zero
    joint_bias: NonNegative = 0.0  # rad, 1σ, of the absolute encoder's zero: what a calibration leaves
    joint_noise: NonNegative = 0.0  # rad, 1σ per sample of the absolute encoder
    force_bias: NonNegative = 0.0  # N m, 1σ, of the load cell's zero
    force_noise: NonNegative = 0.0  # N m, 1σ per sample of the load cell
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
    actuator: AnyActuator
    sensor: JointSensor

    @model_validator(mode="after")
    def _within_linkage(self) -> Self:
        linkage = self.actuator.linkage
        if linkage is not None:
            low, high = (limit + linkage.offset for limit in self.limits)
            if not 0 < low < high < math.pi:
                raise ValueError(f"joint {self.name}: limits {self.limits} stretch out or fold its linkage")
        return self

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


class Led(Config):
    """An LED that the motion capture system tells from all others."""

    name: str
    link: str  # the base or a joint, whose link it is on
    position: Vector3  # m, in the link's frame


class MotionCapture(Config):
    """Cameras around the robot that locate the LEDs on it, in a frame of their own that is the world's."""

    rate: Annotated[int, Field(ge=1, le=10_000)]  # exposures per second
    noise: NonNegative  # m, 1σ per axis and exposure
    placement: NonNegative  # m, 1σ per axis: how well it is known where on its link an LED is
    resolution: Positive  # m per count
    leds: Annotated[tuple[Led, ...], Field(alias="led", min_length=1, max_length=16)]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(led.name for led in self.leds)


class Robot(Config):
    """A whole robot: floating base, joints in the order of the generalised coordinates, feet, buses, IMU, LEDs.

    A test stand has joints only: no feet, no IMU.
    """

    name: str
    source: str = ""  # what ``load`` was given
    gravity: Positive
    foot_radius: NonNegative = 0.0
    base: Base
    joints: tuple[Joint, ...] = Field(alias="joint")
    feet: tuple[Foot, ...] = Field(alias="foot", default=())
    buses: tuple[Bus, ...] = Field(alias="bus")
    imu: Imu | None = None
    motion_capture: MotionCapture | None = None

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
        leds = self.motion_capture.leds if self.motion_capture is not None else ()
        for led in leds:
            if led.link not in known:
                raise ValueError(f"LED {led.name}: there is no link {led.link!r}")
        if len({led.name for led in leds}) < len(leds):
            raise ValueError("two LEDs have one name")
        return self

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return self.base.mass + sum(joint.link.mass for joint in self.joints)

    def with_masses(self, factor: float) -> Self:
        """With all links' masses and inertias times ``factor``; rotors are the actuators'."""
        joints = tuple(joint.model_copy(update={"link": joint.link.with_mass(factor)}) for joint in self.joints)
        return self.model_copy(update={"base": self.base.with_mass(factor), "joints": joints})

    def joint(self, name: str) -> Joint:
        return self.joints[self.joint_names.index(name)]

    def joints_of(self, bus: Bus) -> tuple[Joint, ...]:
        return tuple(self.joint(name) for name in bus.joints)


def available() -> list[str]:
    """Names of the robots that have a description."""
    return sorted(f.name[:-5] for f in resources.files("robots").iterdir() if f.name.endswith(".toml"))


def load(name: str, variant: str | None = None) -> Robot:
    """The robot ``name`` (built in, or the path of a TOML file), with the masses of ``variant`` if one is named.

    An actuator's ``motor`` may name a table ``[motor.NAME]`` of the file, its ``kind`` a class of one's own as
    ``FILE.py:CLASS``, relative to the TOML file: that Python file is executed.

    Raises UnknownRobotError for a robot or variant without a description, and for a wrong description.
    """
    text, place, folder = _read(name)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UnknownRobotError(f"{place}: {error}") from None
    variants = data.pop("variant", {})
    if variant is not None:
        if variant not in variants:
            raise UnknownRobotError(f"{name} has no variant {variant!r}; there is: {', '.join(variants) or 'none'}")
        for part, change in variants[variant].items():
            link = data["base"] if part == data["base"]["name"] else next(
                joint["link"] for joint in data["joint"] if joint["name"] == part
            )
            link.update(change)
    motors = data.pop("motor", {})
    try:
        for joint in data.get("joint", ()):
            _resolve(joint, motors, folder)
        return Robot.model_validate({**data, "source": name})
    except ValidationError as error:
        raise UnknownRobotError(f"{place}: {_sentence(error, data)}") from None
    except _DescriptionError as error:
        raise UnknownRobotError(f"{place}: {error}") from None


class _DescriptionError(ValueError):
    pass


def _sentence(error: ValidationError, data: dict[str, Any]) -> str:
    """What is wrong first, with its place: a joint, foot or bus by its name, not by its number."""
    first = error.errors(include_url=False)[0]
    node: Any = data
    words = []
    for part in first["loc"]:
        if isinstance(node, Mapping) and part not in node and first["loc"][-1] != part:
            continue  # pydantic's tag of a member of a union
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            node = None
        named = isinstance(part, int) and isinstance(node, Mapping) and "name" in node
        words.append(str(node["name"] if named else part))
    message = first["msg"].removeprefix("Value error, ")
    return f"{'.'.join(words)}: {message}" if words else message


def _read(name: str) -> tuple[str, str, Path | None]:
    """Text of the description, what to call it, and the folder that it may take Python files from."""
    path = Path(name)
    if path.suffix == ".toml":
        try:
            return path.read_text(encoding="utf-8"), name, path.parent
        except (OSError, UnicodeDecodeError) as error:
            raise UnknownRobotError(f"{name}: cannot be read ({error})") from None
    if name not in available():
        raise UnknownRobotError(f"no robot {name!r}; there is: {', '.join(available())}, or the path of a TOML file")
    text = resources.files("robots").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    return text, f"robots/{name}.toml", None


def _resolve(joint: dict[str, Any], motors: dict[str, Any], folder: Path | None) -> None:
    """Replace what ``joint``'s actuator names by what it means."""
    actuator, where = joint.get("actuator"), f"joint {joint.get('name')}"
    if not isinstance(actuator, dict):
        return
    motor = actuator.get("motor")
    if isinstance(motor, str):
        if motor not in motors:
            raise _DescriptionError(f"{where}: no [motor.{motor}]; there is: {', '.join(motors) or 'none'}")
        actuator["motor"] = motors[motor]
    kind = actuator.get("kind", "sea")
    if isinstance(kind, str) and ":" in kind and folder is not None:
        described = _own_class(kind, folder, where)
        try:
            joint["actuator"] = described.model_validate(actuator)
        except ValidationError as error:
            raise _DescriptionError(f"{where}: actuator.{_sentence(error, actuator)}") from None
    elif kind not in BUILT_IN:
        raise _DescriptionError(
            f"{where}: actuator.kind = {kind!r}: expected one of {', '.join(BUILT_IN)}, or FILE.py:CLASS for one of "
            "your own"
        )


def _own_class(kind: str, folder: Path, where: str) -> type[Actuator]:
    """The class that ``FILE.py:CLASS`` names. The file is executed."""
    file, _, name = kind.rpartition(":")
    path = folder / file
    module_name = f"robots.own.{path.resolve().as_posix().replace('.', '_')}"
    module = sys.modules.get(module_name)
    if module is None:
        spec = importlib.util.spec_from_file_location(module_name, path)
        if spec is None or spec.loader is None or not path.is_file():
            raise _DescriptionError(f"{where}: actuator.kind = {kind!r}: there is no Python file {path}")
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module  # pydantic looks types up there
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            del sys.modules[module_name]
            raise _DescriptionError(f"{where}: {path}: {type(error).__name__}: {error}") from error
    described = getattr(module, name, None)
    if not (isinstance(described, type) and issubclass(described, Actuator)):
        raise _DescriptionError(f"{where}: {path} has no {name} that is derived from robots.actuators.Actuator")
    return described
