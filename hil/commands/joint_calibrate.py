"""``hil joint calibrate``: the offsets of all absolute encoders at once, over the bus."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, UserError

if TYPE_CHECKING:
    from hil.calibration.bus import Measured
    from robots.description import Robot

_SAMPLES = 20


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "calibrate", help="find the offsets of all joints' absolute encoders at once, over the bus",
        description="With the joints in a known posture (against a jig, hung from the hoist), read the absolute "
        "encoders of all drives on the buses and write their offsets for firmware.calibration. Exit status 1: a "
        "drive's position is further off than --tolerance, with --check or after --write.",
    )  # fmt: skip
    parser.add_argument("robot", metavar="ROBOT", help="whose joints they are: hume …")
    parser.add_argument(
        "--can", action="append", required=True, metavar="INTERFACE:CHANNEL", dest="buses",
        help="bus to look for drives on, e.g. hil:left_leg, socketcan:can0; repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--posture", action="append", required=True, metavar="JOINT=ANGLE|FILE",
        help="where the joints are: left_knee=0.3rad, or a TOML file with such lines; repeatable",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the calibration there, e.g. calibration.toml")
    parser.add_argument("--write", action="store_true", help="put the offsets in force in the drives, too")
    parser.add_argument("--check", action="store_true", help="only tell how far the drives' positions are off")
    parser.add_argument("--tolerance", default="2mrad", metavar="ANGLE", help="of --check, and of rest (2mrad)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_calibrate)


def _calibrate(options: argparse.Namespace) -> int:
    from hil.calibration import bus, file
    from robots import description
    from robots.quantities import parse_quantity

    try:
        robot = description.load(options.robot)
    except description.UnknownRobotError as error:
        raise UserError(str(error)) from None
    if options.check and (options.write or options.out):
        raise UserError("--check only looks: it goes with neither --write nor --out")
    try:
        tolerance = parse_quantity(options.tolerance, "rad")
    except ValueError as error:
        raise UserError(f"--tolerance {options.tolerance}: {error}") from None
    if tolerance <= 0:
        raise UserError(f"--tolerance {options.tolerance}: expected more than 0 rad")
    posture = posture_of(options.posture, robot)
    with bus.drives(robot, options.buses) as found:
        names = [drive.joint.name for drive in found]
        for name in posture:
            if name not in names:
                raise UserError(f"--posture {name}: no such drive is on {', '.join(options.buses)}")
        measured = bus.measure(found, posture, _SAMPLES, tolerance)
        after = measured
        if options.write:
            offsets = {m.joint: m.offset for m in measured}
            for drive in found:
                if drive.joint.name in offsets:
                    drive.set_offset(offsets[drive.joint.name])
            after = bus.measure(found, posture, _SAMPLES, tolerance)
    if options.out is not None:
        how = f"written by `hil joint calibrate {options.robot}`: mean of {_SAMPLES} readings in a known posture"
        try:
            file.write(options.out, robot, {m.joint: m.offset for m in measured}, how)
        except OSError as error:
            raise UserError(f"--out {options.out}: cannot be written ({error.strerror})") from None
    rows = [_row(m, left, options) for m, left in zip(measured, after, strict=True)]
    beyond = [m.joint for m in after if abs(m.residual) > tolerance]
    if options.json:
        print(json.dumps({"joints": rows, "beyond_tolerance": beyond if options.check or options.write else None}))
    else:
        _print(rows, options, [name for name in names if name not in posture], beyond)
    return EXIT_UNSTABLE if beyond and (options.check or options.write) else EXIT_STABLE


def posture_of(given: list[str], robot: Robot) -> dict[str, float]:
    """Angles [rad] by joint from ``JOINT=ANGLE`` and the names of TOML files. Raises UserError."""
    import tomllib

    from hil.schema import nearest
    from robots.quantities import parse_quantity

    posture: dict[str, float] = {}
    for text in given:
        name, separator, angle = text.partition("=")
        entries: dict[str, Any] = {name.strip(): angle.strip()}
        if not separator:
            try:
                entries = tomllib.loads(Path(text).read_text(encoding="utf-8"))
            except OSError as error:
                raise UserError(f"--posture {text}: neither JOINT=ANGLE nor a file ({error.strerror})") from None
            except ValueError as error:
                raise UserError(f"--posture {text}: not valid TOML ({error})") from None
        for joint, value in entries.items():
            if joint not in robot.joint_names:
                near = nearest(joint, robot.joint_names)
                raise UserError(f"--posture {text}: {robot.name} has no joint {joint!r}{near}")
            try:
                posture[joint] = parse_quantity(value, "rad")
            except ValueError as error:
                raise UserError(f"--posture {text}: {joint}: {error}") from None
    return posture


def _row(measured: Measured, after: Measured, options: argparse.Namespace) -> dict[str, Any]:
    row = {
        "joint": measured.joint, "node": measured.node, "posture_rad": measured.posture,
        "reading_rad": measured.reading, "spread_rad": measured.spread, "offset_before_rad": measured.before,
        "offset_rad": measured.offset, "residual_before_rad": measured.residual,
    }  # fmt: skip
    return {**row, "residual_rad": after.residual} if options.write else row


def _print(rows: list[dict[str, Any]], options: argparse.Namespace, others: list[str], beyond: list[str]) -> None:
    head = f"{'joint':16} {'node':>4} {'posture':>9} {'reading':>9} {'offset was':>10} {'offset is':>9} {'error':>9}"
    print(head + (f" {'then':>9}" if options.write else "") + "   [rad]")
    for row in rows:
        line = (
            f"{row['joint']:16} {row['node']:4d} {row['posture_rad']:9.4f} {row['reading_rad']:9.4f} "
            f"{row['offset_before_rad']:10.4f} {row['offset_rad']:9.4f} {row['residual_before_rad']:9.4f}"
        )
        print(line + (f" {row['residual_rad']:9.4f}" if options.write else ""))
    if others:
        print(f"not in the posture, left as they are: {', '.join(others)}")
    if options.out is not None:
        print(f"written to {options.out}; scenarios and joints take it with --set firmware.calibration={options.out}")
    if options.check or options.write:
        print(
            f"further off than {options.tolerance}: {', '.join(beyond)}" if beyond
            else f"all within {options.tolerance}"
        )  # fmt: skip
