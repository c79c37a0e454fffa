"""``hil export``: the control law of a robot's drives as C99 for their processors."""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import UserError

if TYPE_CHECKING:
    from hil.scenario import Scenario

_RECORDED_S = 1.0
_BUILT = {"example"}  # by the export's own Makefile


def add_parser(commands: Any) -> None:
    """The subcommand ``export``."""
    parser = commands.add_parser(
        "export", help="write the control law of a robot's drives as C99",
        description="Write the control law that the emulated drives run as C99 for a real processor.",
    )  # fmt: skip
    parser.add_argument("--robot", default="hume", metavar="NAME", help="whose drives (hume)")
    parser.add_argument("--joint", metavar="NAME", help="the table of this joint's parameters only (all joints)")
    parser.add_argument("--law", metavar="NAME", help="torque loop, as --set firmware.law (PID_m)")
    parser.add_argument("--precision", default="double", metavar="WHICH", help="arithmetic: double (default) or single")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new directory, or one of an export")
    parser.add_argument(
        "--recording", metavar="SCENARIO",
        help="also write what the drives read in the first second of SCENARIO, and what they computed (.csv)",
    )  # fmt: skip
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="as in a scenario, e.g. firmware.stance.kp=4; repeatable",
    )  # fmt: skip
    parser.set_defaults(command=_export)


def find_law(name: str) -> str:
    """The law that a person calls ``name``: case, "_" and spaces make no difference. Raises UserError for none."""
    from hil.schema import nearest
    from joint_firmware.config import LAW_NAMES, canonical_law

    law = canonical_law(name)
    if law not in LAW_NAMES:
        raise UserError(f"--law {name}: there is none{nearest(name, LAW_NAMES)}")
    return law


def _export(options: argparse.Namespace) -> int:
    from hil.schema import nearest
    from joint_firmware.export.c99 import PRECISIONS, export
    from robots import description

    if options.law is not None:
        options.settings.append(f"firmware.law={find_law(options.law)}")
    if options.precision not in PRECISIONS:
        raise UserError(f"--precision {options.precision}: expected {' or '.join(PRECISIONS)}")
    scenario = _scenario(options)
    robot = description.load(scenario.robot)
    if options.joint is not None and options.joint not in robot.joint_names:
        raise UserError(f"--joint {options.joint}: {robot.name} has none{nearest(options.joint, robot.joint_names)}")
    joints = robot.joint_names if options.joint is None else (options.joint,)
    try:
        files = export(robot, joints, options.precision, scenario.firmware)
    except ValueError as error:
        raise UserError(f"--robot {robot.name}: {error}") from None
    names = [*files, *(_recording_names(joints) if options.recording else ())]
    _check(options.out, names)
    if options.recording is not None:
        files |= _recordings(options, joints)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (options.out / name).write_text(text, encoding="utf-8")
            print(options.out / name)
    except OSError as error:
        raise UserError(f"--out {options.out}: {error.strerror}") from None
    return 0


def _scenario(options: argparse.Namespace) -> Scenario:
    """The firmware's configuration is a scenario's; of which one does not matter unless pins are to be recorded."""
    from hil.scenario import load

    for setting in options.settings:
        if options.recording is None and not setting.strip().startswith("firmware."):
            raise UserError(f"--set {setting}: without --recording there is firmware.… only")
    name = options.recording or "stand"
    settings = [f"robot={options.robot}", *options.settings]
    if options.recording is None:
        settings += [f"world.rate={rate:.12g} Hz" for rate in _rates(options.settings)]  # there is no physics: it fits
    try:
        return load(name, settings)
    except UserError as error:
        text = str(error)
        raise UserError(text if options.recording else text.removeprefix("stand: ")) from None


def _rates(settings: list[str]) -> list[float]:
    """Interrupt rates among ``settings``, Hz; what is wrong with the others, loading the scenario says."""
    from robots.quantities import parse_quantity

    rates = []
    for setting in settings:
        key, _, value = setting.partition("=")
        if key.strip() == "firmware.rate":
            with contextlib.suppress(ValueError):
                rates.append(parse_quantity(value, "Hz"))
    return [rate for rate in rates if 1 <= rate <= 1e6]


def _check(out: Path, names: list[str]) -> None:
    """Refuse a file, and a directory in which something else would lie beside the export."""
    if not out.exists():
        return
    if not out.is_dir():
        raise UserError(f"--out {out}: is a file; name a directory")
    try:
        others = sorted(set(os.listdir(out)) - set(names) - _BUILT)
    except OSError as error:
        raise UserError(f"--out {out}: {error.strerror}") from None
    if others:
        raise UserError(f"--out {out}: holds {others[0]}, which is not of this export; name a new or empty directory")


def _recording_names(joints: tuple[str, ...]) -> list[str]:
    return [f"{what}_{joint}.csv" for joint in joints for what in ("recorded", "computed")]


def _recordings(options: argparse.Namespace, joints: tuple[str, ...]) -> dict[str, str]:
    """What the export's example reads, and what it prints in double precision."""
    from hil.record.law_recording import parameter_lines, record_laws
    from joint_firmware.export.c99 import columns_in
    from joint_firmware.export.drive_law import exported_law
    from robots import description

    scenario = _scenario(options)
    recorded = record_laws(scenario, _RECORDED_S)
    joint = description.load(scenario.robot).joint(joints[0])
    named = exported_law(joint, scenario.firmware)
    files = {}
    for name in joints:
        drive = recorded[name]
        inputs = ["# " + ",".join(columns_in(named)), *parameter_lines(drive)]
        inputs += [
            ",".join([*map(str, counts), *map(repr, u)])
            for counts, u in zip(drive.counts.tolist(), drive.u.tolist(), strict=True)
        ]
        outputs = [
            ",".join(f"{value:.17g}" for value in [*y, *x])
            for y, x in zip(drive.y.tolist(), drive.x_next.tolist(), strict=True)
        ]
        files[f"recorded_{name}.csv"] = "\n".join(inputs) + "\n"
        files[f"computed_{name}.csv"] = "\n".join(outputs) + "\n"
    return files
