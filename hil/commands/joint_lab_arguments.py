"""What the laboratory's subcommands of ``hil joint`` have in common: which joint, which setup, which laws."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hil.commands.arguments import natural
from hil.commands.joint_arguments import LOADS, load_of, named, node_id, scenario_of, which
from hil.errors import UserError

if TYPE_CHECKING:
    from hil.joint_lab.setup import Setup

_CONTROLLER = {f"{key}=": key for key in ("controller.rate", "controller.phase", "controller.compute_time")}
_PHYSICS_STEPS = 20  # per interrupt of the drive: an experiment is compared with exact theory
_ALL, OPEN_LOOP, _VALVE = "all", "open", "valve"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The joint, its load and settings, and where the results go."""
    parser.add_argument("robot", metavar="ROBOT", help="whose joint: vlca, hume …, or a TOML file")
    parser.add_argument("--joint", metavar="NAME", help="which, if it has several, e.g. left_knee")
    parser.add_argument("--node", type=node_id, metavar="ID", help="instead of --joint: its CANopen node id")
    parser.add_argument("--load", default="locked", metavar="LOAD", help=f"on the output (locked): {LOADS}")
    parser.add_argument("--rate", metavar="HZ", help="ISR rate, e.g. 5kHz; it reports at half of it")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="as in a scenario, e.g. firmware.stance.kp=3; repeatable",
    )  # fmt: skip
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="of the sensors' errors (0)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write plots and logs there")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def setup_of(options: argparse.Namespace, smooth: bool = False) -> Setup:
    """The experiment that ``options`` describe, with the gains that the sources print for its joint unless --set says
    other ones. ``smooth``: without dry friction, unless --set says how much. Raises UserError."""
    from hil.compiled import compile_function
    from hil.joint_lab import published
    from hil.joint_lab.setup import Setup, Timing
    from robots import description

    robot = description.load(scenario_of(options, _CONTROLLER).robot)
    joint_index = which(options, robot)
    joint, load = robot.joints[joint_index], load_of(options.load)
    if not joint.limits[0] <= load.at <= joint.limits[1]:
        low, high = joint.limits
        raise UserError(
            f"--load {options.load}: {joint.name} goes from {low:g} rad to {high:g} rad, not to at = {load.at:g}"
        )
    defaults = [*published.settings(joint), *(["world.friction_scale=0"] if smooth else [])]
    asked = named(options)
    scenario = scenario_of(
        argparse.Namespace(**{**vars(options), "settings": [*defaults, *options.settings]}), _CONTROLLER
    )
    firmware, controller, world = scenario.firmware, scenario.controller, scenario.world
    servo = controller.rate if "controller.rate" in asked else firmware.report_rate
    if servo != firmware.report_rate:
        raise UserError(
            f"controller.rate = {servo:g} Hz: expected the drive's report rate, {firmware.report_rate:g} Hz"
        )
    physics = world.rate if "world.rate" in asked else _PHYSICS_STEPS * firmware.rate
    timing = Timing(servo, physics, controller.phase, controller.compute_time)
    return Setup(
        robot, joint_index, firmware, load, scenario.sensors, timing, world.friction_scale, seed=options.seed,
        compile=compile_function,
    )  # fmt: skip


def laws_of(options: argparse.Namespace, setup: Setup, open_loop: bool = False) -> dict[str, Setup]:
    """A setup for each law that --law names, or for all; with ``open_loop`` the drive without one, too.

    Raises UserError.
    """
    from bus.messages import Mode
    from hil.joint_lab.continuous import FEEDBACKS
    from hil.schema import nearest
    from joint_firmware.config import canonical_law

    laws = [_VALVE] if setup.hydraulic else list(FEEDBACKS)
    known = {law: setup._replace(firmware=setup.firmware.model_copy(update={"law": law})) for law in laws}
    if open_loop and not setup.hydraulic:  # a valve alone lets the torque drift
        known[OPEN_LOOP] = setup._replace(mode=Mode.OPEN_LOOP)
    if options.law.strip() == _ALL:
        return known
    chosen = [canonical_law(name.strip()) for name in options.law.split(",")]
    for law in chosen:
        if law not in known:
            raise UserError(f"--law {law}: no such torque loop{nearest(law, [*known, _ALL])}")
    return {law: known[law] for law in chosen}


def quantity(options: argparse.Namespace, name: str, option: str, unit: str) -> float:
    """The value of ``option`` in the SI unit ``unit``. Raises UserError."""
    from robots.quantities import parse_quantity

    try:
        return parse_quantity(getattr(options, name), unit)
    except ValueError as error:
        raise UserError(f"{option}: {error}") from None


def directory(out: Path | None) -> Path | None:
    """``out``, created. Raises UserError."""
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--out {out}: cannot be created ({error.strerror})") from None
    return out
