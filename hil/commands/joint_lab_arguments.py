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

_CONTROLLER = ("controller.rate", "controller.phase", "controller.compute_time")
_PHYSICS_STEPS = 20  # per interrupt of the drive: an experiment is compared with exact theory
_ALL = "all"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The joint, its load and settings, and where the results go."""
    parser.add_argument("robot", metavar="ROBOT", help="whose joint it is: vlca, hume …")
    parser.add_argument("--joint", metavar="NAME", help="which, where the robot has several, e.g. left_knee")
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


def setup_of(options: argparse.Namespace) -> Setup:
    """The experiment that ``options`` describe. Raises UserError."""
    from hil.compiled import compile_function
    from hil.joint_lab.setup import Setup, Timing
    from robots import description

    scenario, load = scenario_of(options, _CONTROLLER), load_of(options.load)
    robot = description.load(scenario.robot)
    firmware, controller, world = scenario.firmware, scenario.controller, scenario.world
    servo = controller.rate if "controller.rate" in named(options) else firmware.report_rate
    if servo != firmware.report_rate:
        raise UserError(
            f"controller.rate = {servo:g} Hz: expected the drive's report rate, {firmware.report_rate:g} Hz"
        )
    physics = world.rate if "world.rate" in named(options) else _PHYSICS_STEPS * firmware.rate
    timing = Timing(servo, physics, controller.phase, controller.compute_time)
    return Setup(
        robot, which(options, robot), firmware, load, scenario.sensors, timing, world.friction_scale, options.seed,
        compile_function,
    )  # fmt: skip


def directory(out: Path | None) -> Path | None:
    """``out``, created. Raises UserError."""
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--out {out}: cannot be created ({error.strerror})") from None
    return out
