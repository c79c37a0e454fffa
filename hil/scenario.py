"""Scenarios: TOML files with units, validated on load; ``--set KEY=VALUE`` changes one value."""

from __future__ import annotations

import tomllib
import typing
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from bus.config import BusConfig, LinkConfig
from central_controller.config import ControllerConfig
from central_controller.planning.height_surface import over_blocks
from hil import schema
from hil.analysis.verdict import VerdictConfig
from hil.calibration import file as calibration
from hil.errors import UserError
from joint_firmware.config import FirmwareConfig
from plant.config import (
    SHANK_FORK_INERTIA,
    JointFaults,
    MotionCaptureConfig,
    PushConfig,
    SensorConfig,
    StanceConfig,
    TerrainConfig,
    WorldConfig,
)
from robots import description
from robots.quantities import Config, Seconds


class InjectionConfig(Config):
    """A change of one injectable value at a given time of the run, for good or until another time.

    At ``until`` the value returns to what it was just before ``at``.
    """

    at: Seconds
    until: Seconds | None = None
    key: str  # `hil inject --list` shows them, e.g. link.command.delay
    value: str | float | bool  # with its unit, e.g. "3ms"


class Scenario(Config):
    """Everything that determines a run, together with the seed."""

    name: Annotated[str, Field(pattern=r"^[^/*$?#\x00-\x1f]{1,64}$")]  # part of a path and of Zenoh keys
    description: str = ""
    duration: Seconds = 20.0
    robot: str = "hume"
    world: WorldConfig = WorldConfig()
    terrain: TerrainConfig = TerrainConfig()
    stance: StanceConfig = StanceConfig()
    sensors: SensorConfig = SensorConfig()
    motion_capture: MotionCaptureConfig = MotionCaptureConfig()
    firmware: FirmwareConfig = FirmwareConfig()
    controller: ControllerConfig = ControllerConfig()
    link: LinkConfig = LinkConfig()
    bus: dict[str, BusConfig] = Field(default_factory=dict)
    joint: dict[str, JointFaults] = Field(default_factory=dict)  # faults, by joint
    push: tuple[PushConfig, ...] = ()
    inject: tuple[InjectionConfig, ...] = ()
    limits: VerdictConfig = VerdictConfig()


def builtin_names() -> list[str]:
    """Names of the scenarios that come with the package."""
    files = resources.files("hil").joinpath("scenarios").iterdir()
    return sorted(f.name[:-5] for f in files if f.name.endswith(".toml"))


def load(
    name: str,
    settings: typing.Sequence[str] | Mapping[str, Any] = (),
    inject: typing.Sequence[Mapping[str, Any]] = (),
) -> Scenario:
    """The scenario ``name`` (built in, or the path of a TOML file) with ``settings`` applied: "key=value", or values
    by key, texts as on a command line; then ``inject`` (tables as in a file) added to its own.

    Raises UserError with the key's path and what would be right.
    """
    data, source = _read(name)
    pairs = list(settings.items() if isinstance(settings, Mapping) else map(_setting, settings))
    for key, value in pairs:
        if not isinstance(key, str) or not all(part.strip() for part in key.split(".")):
            raise UserError(f"{key!r} is no key; one is, for example, 'link.command.delay'")
        assign(data, key.strip(), _literal(value.strip()) if isinstance(value, str) else value)
    if inject:
        own = data.get("inject", [])
        data["inject"] = [*own, *inject] if isinstance(own, list) else own
    folder = Path(source).parent if source.endswith(".toml") else Path()
    _calibrate(data, folder, [key.strip() for key, _ in pairs])
    return complete(data, source)


def _setting(text: str) -> tuple[str, str]:
    key, separator, value = text.partition("=")
    if not separator or not all(part.strip() for part in key.split(".")):
        raise UserError(f"--set {text}: expected KEY=VALUE, for example --set link.command.delay=3ms")
    return key, value


def _calibrate(data: dict[str, Any], folder: Path, keys: typing.Sequence[str]) -> None:
    """Take over the file that ``firmware.calibration`` names: beside the scenario, or if one of the ``keys`` set, from
    here."""
    if f"firmware.{calibration.KEY}" in keys:
        folder = Path()
    try:
        robot = description.load(data.get("robot", Scenario.model_fields["robot"].default))
    except (description.UnknownRobotError, AttributeError, TypeError):
        return  # which the scenario's own check tells
    calibration.take_over(data, robot, folder)


def complete(data: dict[str, Any], source: str) -> Scenario:
    """The scenario of ``data`` (of the file or place ``source``), checked as a whole, with all buses of its robot.

    Raises UserError with the key's path and what would be right.
    """
    scenario = _with_believed_ground(validate(data, source))
    _check_consistency(scenario, source)
    robot = description.load(scenario.robot)
    buses = {bus.name: scenario.bus.get(bus.name, BusConfig()) for bus in robot.buses}
    return scenario.model_copy(update={"bus": buses})


def _with_believed_ground(scenario: Scenario) -> Scenario:
    """A controller that is told of no blocks knows those of the terrain."""
    controller = scenario.controller
    if controller.blocks is not None:
        return scenario
    controller = controller.model_copy(update={"blocks": scenario.terrain.blocks})
    return scenario.model_copy(update={"controller": controller})


def from_record(configuration: dict[str, Any], source: str) -> Scenario:
    """The scenario of a ``model_dump`` that a run has recorded at ``source``. Raises UserError for anything else."""
    try:
        data = tomllib.loads(to_toml(configuration))
    except (ValueError, TypeError, AttributeError):
        raise UserError(f"{source} is no scenario") from None
    return complete(data, source)


def validate(data: dict[str, Any], source: str = "") -> Scenario:
    """Check ``data`` against the schema. Raises UserError naming a wrong key and what would be right."""
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        errors = error.errors()
        # a typo explains the rest
        first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
        sentence = schema.sentence(first, Scenario)
        raise UserError(f"{source}: {sentence}" if source else sentence) from None


def parse_value(key: str, value: Any) -> float | bool | str:
    """Read one setting as the scenario would: ``parse_value("link.command.delay", "3ms")`` is 0.003.

    Raises UserError for an unknown key or a value that the key does not take.
    """
    data: dict[str, Any] = {"name": "value"}
    assign(data, key, value)
    node: Any = validate(data)
    for part in key.split("."):
        node = node[part] if isinstance(node, dict) else getattr(node, part)
    if not isinstance(node, int | float | str):
        raise UserError(f"{key} is not a single value")
    return node


def to_toml(configuration: Mapping[str, Any]) -> str:
    """A scenario's ``model_dump`` (``configuration`` in run.json) as a file that loads as an equal scenario.

    One line per value, each as ``--set`` takes it.
    """
    return schema.to_toml(configuration, Scenario)


def _read(name: str) -> tuple[dict[str, Any], str]:
    path = Path(name)
    if path.suffix == ".toml":
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise UserError(f"{name}: cannot be read ({error.strerror})") from None
        except UnicodeDecodeError as error:
            raise UserError(f"{name}: not valid TOML (byte {error.start} is not UTF-8)") from None
        source = name
    elif name in builtin_names():
        text = resources.files("hil").joinpath("scenarios", f"{name}.toml").read_text(encoding="utf-8")
        source = name
    else:
        nearest = schema.nearest(name, builtin_names())
        raise UserError(f"no scenario {name!r}{nearest} (a file of your own ends in .toml)")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{source}: not valid TOML ({error})") from None
    data.setdefault("name", path.stem)
    return data, source


def _literal(text: str) -> Any:
    """A value as TOML would read it; anything else is a string, so that units need no quotes on a command line."""
    try:
        read = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return read["value"] if len(read) == 1 else text


def assign(data: dict[str, Any], key: str, value: Any) -> None:
    """Set ``key`` of the scenario file's content ``data``. Raises UserError where a table is in the way of it."""
    *parents, leaf = key.split(".")
    node = data
    for part in parents:
        node = node.setdefault(part, {})
        if isinstance(node, list):
            raise UserError(f"{key}: {part!r} is a list; give all of it, as in --set '{part}=[{{…}}, {{…}}]'")
        if not isinstance(node, dict):
            raise UserError(f"{key}: {part!r} is a value, not a table")
    node[leaf] = value


def _check_consistency(scenario: Scenario, source: str) -> None:
    """What one key alone cannot tell: names of the robot, and times and rates that must fit each other."""
    for problem in _inconsistencies(scenario):
        raise UserError(f"{source}: {problem}")


def _inconsistencies(scenario: Scenario) -> Iterator[str]:
    try:
        robot = description.load(scenario.robot)
    except description.UnknownRobotError as error:
        yield f"robot = {scenario.robot!r}: {error}"
        return
    for key, variant in (("world", scenario.world.variant), ("controller", scenario.controller.variant)):
        try:
            description.load(scenario.robot, variant)
        except description.UnknownRobotError as error:
            yield f"{key}.variant = {variant!r}: {error}"
    ramp = scenario.controller.stepping.planner.ramp
    try:
        over_blocks(1.0, scenario.controller.blocks or (), ramp)
    except ValueError:
        if scenario.controller.behaviour == "step":
            yield (
                f"controller.stepping.planner.ramp = {ramp:g} m is too long: "
                "each block, and each gap between two of them, must be longer"
            )
    if scenario.controller.behaviour == "open_loop":
        yield from _wrong_plan(scenario, robot)
    names = [bus.name for bus in robot.buses]
    for name in scenario.bus:
        if name not in names:
            yield f"unknown key {f'bus.{name}'!r}{schema.nearest(name, names, 'bus')}"
    firmware, controller = scenario.firmware, scenario.controller
    if scenario.motion_capture.enabled and robot.motion_capture is None:
        yield f"motion_capture.enabled: {robot.name} has no LEDs (its description has no [motion_capture])"
    if controller.orientation == "motion_capture" and not scenario.motion_capture.enabled:
        yield 'controller.orientation = "motion_capture": needs motion_capture.enabled = true'
    rates = {
        "world.rate": scenario.world.rate,
        "firmware.rate": firmware.rate,
        "firmware.report_rate": firmware.report_rate,
        "controller.rate": controller.rate,
    }
    for key, rate in rates.items():
        if rate != int(rate) or rate > 1e6:
            yield f"{key} = {rate:.12g} Hz: expected a whole number of hertz, at most 1 MHz"
    for fast, slow in (("world.rate", "firmware.rate"), ("firmware.rate", "firmware.report_rate")):
        if rates[fast] % rates[slow]:
            yield f"{fast} = {rates[fast]:g} Hz: must be a multiple of {slow} ({rates[slow]:g} Hz)"
    stiffest = SHANK_FORK_INERTIA * scenario.world.rate**2  # beyond, physics' steps are too coarse
    if scenario.world.shank_stiffness > stiffest:
        yield (
            f"world.shank_stiffness = {scenario.world.shank_stiffness:g} N m/rad: expected at most {stiffest:g} N m/rad"
            f" with world.rate = {scenario.world.rate:g} Hz, or 0 for rigid shanks"
        )
    period = 1e3 / controller.rate
    for key, value in (("phase", controller.phase), ("compute_time", controller.compute_time)):
        if 1e3 * value >= period:  # one answer is under way at a time
            yield (
                f"controller.{key} = {1e3 * value:g} ms: must be less than the controller's period, "
                f"{period:.4g} ms at controller.rate = {controller.rate:g} Hz"
            )
    for key, value in (
        ("duration", scenario.duration),
        ("controller.path.period", controller.path.period),
        ("controller.orientation_time_constant", controller.orientation_time_constant),
        ("firmware.watchdog", firmware.watchdog),
    ):
        if value <= 0:
            yield f"{key} = {value:g} s: expected more than 0 s"
    for name in scenario.sensors.encoder_offset:
        if name not in robot.joint_names:
            near = schema.nearest(name, robot.joint_names, "sensors.encoder_offset")
            yield f"unknown key {f'sensors.encoder_offset.{name}'!r}{near}"
    yield from _wrong_laws(firmware, robot)
    yield from _wrong_faults(scenario, robot)


def notes(scenario: Scenario) -> list[str]:
    """A sentence for each condition of its torque loop that a drive's gains do not meet: a run may want that."""
    from joint_firmware.laws import doubts

    joints = description.load(scenario.robot).joints
    return [note for joint in joints for note in doubts(joint, scenario.firmware.of_joint(joint.name))]


def _wrong_plan(scenario: Scenario, robot: description.Robot) -> Iterator[str]:
    """Steps planned beforehand that the robot cannot make, or not from where its feet are."""
    from central_controller.planning.open_loop import plan  # scipy takes its time

    controller = scenario.controller
    apart, length = scenario.stance.feet_apart, controller.open_loop.step_length
    if abs(apart - length) > 1e-6:
        yield f"stance.feet_apart = {apart:g} m: must be controller.open_loop.step_length, {length:g} m"
    try:
        plan(robot, controller.open_loop, controller.rate, controller.blocks or ())
    except ValueError as error:
        yield f"controller.open_loop: {error}"


def _wrong_laws(firmware: FirmwareConfig, robot: description.Robot) -> Iterator[str]:
    """Gains of joints that there are not, filters faster than the interrupt, torque loops that cannot be stable."""
    from joint_firmware.laws import doubts  # casadi takes its time

    for name in firmware.joints:
        if name not in robot.joint_names:
            known = schema.nearest(name, robot.joint_names, "firmware.joints")
            yield f"unknown key {f'firmware.joints.{name}'!r}{known}"
    for key in ("torque_rate_cutoff", "observer_cutoff"):
        cutoff = getattr(firmware, key)
        if 2.0 * cutoff >= firmware.rate:
            yield f"firmware.{key} = {cutoff:g} Hz: expected less than half of firmware.rate ({firmware.rate:g} Hz)"
            return
    for joint in robot.joints:
        try:
            doubts(joint, firmware.of_joint(joint.name))
        except ValueError as error:
            yield str(error)


def _wrong_faults(scenario: Scenario, robot: description.Robot) -> Iterator[str]:
    """Nodes and keys that the robot's buses do not have, and injections that contradict each other."""
    from hil.injection import injectable  # it reads values as this module does

    known = injectable(robot)
    keys = list(known)
    for name in scenario.joint:
        if name not in robot.joint_names:
            yield f"unknown key {f'joint.{name}'!r}{schema.nearest(name, robot.joint_names, 'joint')}"
    for bus in robot.buses:
        for name, faults in scenario.bus.get(bus.name, BusConfig()).node.items():
            path = f"bus.{bus.name}.node"
            nodes = list(dict.fromkeys(key.split(".")[3] for key in keys if key.startswith(f"{path}.")))
            if name not in nodes:
                yield f"unknown key {f'{path}.{name}'!r}{schema.nearest(name, nodes, path)}"
            for key in faults.model_fields_set:
                if name in nodes and f"{path}.{name}.{key}" not in known:
                    yield f"{path}.{name}.{key}: only joints have this fault"
    ends: dict[str, tuple[float, int]] = {}  # by key: when the last injection with an end is over, and its number
    for n, injection in sorted(enumerate(scenario.inject), key=lambda item: item[1].at):
        if injection.key not in known:
            yield f"inject.{n}.key = {injection.key!r}: no such key{schema.nearest(injection.key, keys)}"
            continue
        try:
            parse_value(injection.key, injection.value)
        except UserError as error:
            yield f"inject.{n}.value: {error}"
        if injection.until is not None and injection.until <= injection.at:
            yield f"inject.{n}.until = {injection.until:g} s: expected more than its at, {injection.at:g} s"
        over, before = ends.get(injection.key, (0.0, n))
        if injection.at < over:
            yield f"inject.{n}.at = {injection.at:g} s: {injection.key} is under inject.{before} until {over:g} s"
        if injection.until is not None:
            ends[injection.key] = injection.until, n
