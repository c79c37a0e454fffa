"""Arguments that the subcommands of ``hil joint`` share: which joint, its load, its settings."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from hil.errors import UserError

if TYPE_CHECKING:
    from hil.scenario import Scenario
    from plant.bench import Load
    from robots.description import Robot

_PHYSICS = 3000.0  # Hz, at least
LOADS = "inertia=0.5kgm2[,damping=0.5Nms/rad] | pendulum[,mass=3kg,length=0.4m,damping=0.5Nms/rad] | locked"
_ALONE = ("firmware.", "sensors.", "world.friction_scale=", "world.rate=")  # what of a scenario a joint alone has


def node_id(text: str) -> int:
    """1 … 127. Raises argparse.ArgumentTypeError."""
    if not (text.isascii() and text.isdigit() and len(text) <= 3 and 1 <= int(text) <= 127):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 1 to 127")
    return int(text)


def which(options: argparse.Namespace, robot: Robot) -> int:
    """Index of the joint that is meant; a robot's only joint need not be named. Raises UserError."""
    from hil.schema import nearest

    if options.node is None and options.joint is None and len(robot.joints) == 1:
        return 0
    nodes = {joint.node_id: n for n, joint in enumerate(robot.joints)}
    if (options.node is None) == (options.joint is None):
        raise UserError("name the joint, either by --node or by --joint, for example --node 3")
    if options.joint is not None:
        if options.joint not in robot.joint_names:
            raise UserError(
                f"--joint {options.joint}: {robot.name} has none{nearest(options.joint, robot.joint_names)}"
            )
        return robot.joint_names.index(options.joint)
    if options.node not in nodes:
        there = ", ".join(f"{node} ({robot.joints[n].name})" for node, n in nodes.items())
        raise UserError(f"--node {options.node}: {robot.name} has none; there is {there}")
    return nodes[options.node]


def load_of(text: str) -> Load:
    """The load that ``KIND[=VALUE][,KEY=VALUE…]`` describes. Raises UserError."""
    from pydantic import ValidationError

    from hil import schema
    from plant.bench import LOADS

    parts = text.split(",")
    kind = parts[0].partition("=")[0].strip()
    if kind not in LOADS:
        raise UserError(f"--load {text}: no load {kind!r}{schema.nearest(kind, list(LOADS))}")
    values = {}
    for part in parts if "=" in parts[0] else parts[1:]:
        key, separator, value = part.partition("=")
        if not separator:
            raise UserError(f"--load {text}: {part!r} is not KEY=VALUE")
        values[key.strip()] = value.strip()
    try:
        return LOADS[kind].model_validate(values)
    except ValidationError as error:
        raise UserError(f"--load {text}: {schema.sentence(error.errors()[0], LOADS[kind])}") from None


def scenario_of(options: argparse.Namespace, further: Mapping[str, str] = MappingProxyType({})) -> Scenario:
    """What of a scenario a joint alone has: firmware, sensors, the actuator's friction and the physics' rate.

    further: what else may be set, by how the key begins, and what to call it. Raises UserError.
    """
    from hil.scenario import load
    from robots.quantities import parse_quantity

    for setting in options.settings:
        if not setting.strip().startswith((*_ALONE, *further)):
            names = ", ".join(["firmware.…", "sensors.…", *further.values(), "world.friction_scale"])
            raise UserError(f"--set {setting}: a joint alone has {names} and world.rate")
    settings = [f"robot={options.robot}", *options.settings]
    if options.rate is not None:
        try:
            rate = parse_quantity(options.rate, "Hz")
        except ValueError as error:
            raise UserError(f"--rate {options.rate}: {error}") from None
        if not 1 <= rate <= 1e6:
            raise UserError(f"--rate {options.rate}: expected 1 Hz to 1 MHz")
        settings.append(f"firmware.rate={rate:.12g} Hz")
        if "firmware.report_rate" not in named(options):
            settings.append(f"firmware.report_rate={rate / 2:.12g} Hz")
        if "world.rate" not in named(options):
            settings.append(f"world.rate={rate * math.ceil(_PHYSICS / rate):.12g} Hz")
    try:
        return load("stand", settings)
    except UserError as error:
        raise UserError(str(error).removeprefix("stand: ")) from None  # which scenario does not matter


def seconds(text: str | None, option: str = "--duration") -> float | None:
    """A time of more than 0 s, None for None. Raises UserError."""
    from robots.quantities import parse_quantity

    if text is None:
        return None
    try:
        duration = parse_quantity(text, "s")
    except ValueError as error:
        raise UserError(f"{option}: {error}") from None
    if not 0 < duration <= 1e6:
        raise UserError(f"{option} {text}: expected more than 0 s")
    return duration


def named(options: argparse.Namespace) -> set[str]:
    """Keys that --set names."""
    return {setting.partition("=")[0].strip() for setting in options.settings}
