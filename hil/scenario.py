"""Scenarios: TOML files with units, validated on load; ``--set KEY=VALUE`` changes one value."""

from __future__ import annotations

import difflib
import tomllib
import types
import typing
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, ValidationError

from bus.config import BusConfig, LinkConfig
from central_controller.config import ControllerConfig
from hil.errors import UserError
from hil.verdict import VerdictConfig
from joint_firmware.config import FirmwareConfig
from plant.config import PushConfig, SensorConfig, StanceConfig, TerrainConfig, WorldConfig
from robots import description
from robots.quantities import Config, Seconds


class InjectionConfig(Config):
    """A change of one impairment at a given time of the run."""

    at: Seconds
    key: str  # an injectable key, e.g. link.command.delay
    value: str | float  # with its unit, e.g. "3ms"


class Scenario(Config):
    """Everything that determines a run, together with the seed."""

    name: str
    description: str = ""
    duration: Seconds = 20.0
    robot: str = "hume"
    world: WorldConfig = WorldConfig()
    terrain: TerrainConfig = TerrainConfig()
    stance: StanceConfig = StanceConfig()
    sensors: SensorConfig = SensorConfig()
    firmware: FirmwareConfig = FirmwareConfig()
    controller: ControllerConfig = ControllerConfig()
    link: LinkConfig = LinkConfig()
    bus: dict[str, BusConfig] = Field(default_factory=dict)
    push: tuple[PushConfig, ...] = ()
    inject: tuple[InjectionConfig, ...] = ()
    limits: VerdictConfig = VerdictConfig()


def builtin_names() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(f.name[:-5] for f in resources.files("hil").joinpath("scenarios").iterdir() if f.name.endswith(".toml"))


def load(name: str, settings: typing.Sequence[str] = ()) -> Scenario:
    """The scenario ``name`` (built in, or the path of a TOML file) with ``settings`` ("key=value") applied.

    Raises UserError with the key's path and what would be right.
    """
    data, source = _read(name)
    for setting in settings:
        key, separator, text = setting.partition("=")
        if not separator or not key.strip():
            raise UserError(f"--set {setting}: expected KEY=VALUE, for example --set link.command.delay=3ms")
        _assign(data, key.strip(), _literal(text.strip()))
    scenario = validate(data, source)
    _check_consistency(scenario, source)
    robot = description.load(scenario.robot)
    buses = {bus.name: scenario.bus.get(bus.name, BusConfig()) for bus in robot.buses}
    return scenario.model_copy(update={"bus": buses})


def validate(data: dict[str, Any], source: str) -> Scenario:
    """Check ``data`` against the schema. Raises UserError naming the first wrong key and the nearest right one."""
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise UserError(f"{source}: {_sentence(error.errors()[0])}") from None


def parse_value(key: str, value: Any) -> float:
    """Read one numeric setting as the scenario would: ``parse_value("link.command.delay", "3ms")`` is 0.003.

    Raises UserError for an unknown key or a value that the key does not take.
    """
    data: dict[str, Any] = {"name": "value"}
    _assign(data, key, value)
    node: Any = validate(data, "value")
    for part in key.split("."):
        node = node[part] if isinstance(node, dict) else getattr(node, part)
    return float(node)


def _read(name: str) -> tuple[dict[str, Any], str]:
    path = Path(name)
    if path.suffix == ".toml":
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise UserError(f"{name}: cannot be read ({error.strerror})") from None
        source = name
    elif name in builtin_names():
        text = resources.files("hil").joinpath("scenarios", f"{name}.toml").read_text(encoding="utf-8")
        source = name
    else:
        raise UserError(f"no scenario {name!r}{_nearest(name, builtin_names())}; `hil scenarios` lists them")
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{source}: not valid TOML ({error})") from None
    data.setdefault("name", path.stem)
    return data, source


def _literal(text: str) -> Any:
    """A value as TOML would read it; anything else is a string, so that units need no quotes on a command line."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _assign(data: dict[str, Any], key: str, value: Any) -> None:
    *parents, leaf = key.split(".")
    node = data
    for part in parents:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise UserError(f"{key}: {part!r} is a value, not a table")
    node[leaf] = value


def _sentence(error: Any) -> str:
    """One pydantic error as one sentence: the key's path, what is wrong, what would be right."""
    location = [part for part in error["loc"] if not (isinstance(part, str) and part.startswith("function-"))]
    path = ".".join(str(part) for part in location)
    if error["type"] == "extra_forbidden":
        return f"unknown key {path!r}{_nearest(str(location[-1]), _keys_at(location[:-1]))}"
    if error["type"] == "literal_error":
        return f"{path} = {error['input']!r}: expected {error['ctx']['expected']}"
    message = error["msg"].removeprefix("Value error, ")
    return f"{path} = {error['input']!r}: {message[0].lower()}{message[1:]}"


def _keys_at(location: typing.Sequence[Any]) -> list[str]:
    """Valid keys of the table at ``location`` in the schema."""
    kind: Any = Scenario
    for part in location:
        if isinstance(part, int):
            kind = next(a for a in typing.get_args(kind) if a is not Ellipsis)
        elif typing.get_origin(kind) is dict:
            kind = typing.get_args(kind)[1]
        else:
            kind = kind.model_fields[part].annotation
        if typing.get_origin(kind) in (typing.Union, types.UnionType):
            kind = next(a for a in typing.get_args(kind) if a is not type(None))
    return list(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _nearest(name: str, valid: typing.Sequence[str]) -> str:
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; valid are {', '.join(valid)}" if valid else ""


def _check_consistency(scenario: Scenario, source: str) -> None:
    """What one key alone cannot tell: names of the robot, and rates that must fit each other."""
    try:
        robot = description.load(scenario.robot)
        for variant in (scenario.world.variant, scenario.controller.variant):
            description.load(scenario.robot, variant)
    except description.UnknownRobotError as error:
        raise UserError(f"{source}: {error}") from None
    names = [bus.name for bus in robot.buses]
    for name in scenario.bus:
        if name not in names:
            raise UserError(f"{source}: unknown key 'bus.{name}'{_nearest(name, names)}")
    rates = {
        "world.rate": scenario.world.rate,
        "firmware.rate": scenario.firmware.rate,
        "firmware.report_rate": scenario.firmware.report_rate,
        "controller.rate": scenario.controller.rate,
    }
    for key, rate in rates.items():
        if rate != int(rate) or rate > 1e6:
            raise UserError(f"{source}: {key} = {rate:g} Hz: expected a whole number of hertz, at most 1 MHz")
    for fast, slow in (("world.rate", "firmware.rate"), ("firmware.rate", "firmware.report_rate")):
        if rates[fast] % rates[slow]:
            raise UserError(f"{source}: {fast} ({rates[fast]:g} Hz) must be a multiple of {slow} ({rates[slow]:g} Hz)")
    if scenario.duration <= 0:
        raise UserError(f"{source}: duration = {scenario.duration:g} s: expected more than 0 s")
    from hil.injection import injectable  # the keys depend on the robot's buses

    keys = injectable(names)
    for injection in scenario.inject:
        if injection.key not in keys:
            raise UserError(f"{source}: inject: unknown key {injection.key!r}{_nearest(injection.key, keys)}")
        parse_value(injection.key, injection.value)
