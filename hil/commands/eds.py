"""``hil eds``: the CANopen data sheets of a scenario's drives, as files for any master."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import UserError

if TYPE_CHECKING:
    from hil.scenario import Scenario


def add_parser(commands: Any) -> None:
    """The subcommand ``eds``."""
    parser = commands.add_parser("eds", help="write the CANopen data sheets (EDS) of a scenario's drives")
    parser.add_argument("scenario", metavar="SCENARIO", help="a built-in scenario or the path of a .toml file")
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="where to (the working directory)")
    parser.set_defaults(command=_eds)


def write_data_sheets(out: Path, scenario: Scenario) -> list[Path]:
    """One file per drive, BUS_JOINT.eds, in the directory ``out``. Returns their paths."""
    from joint_firmware.eds import eds
    from joint_firmware.objects import drive_dictionary
    from robots import description

    robot = description.load(scenario.robot)
    written = []
    for bus in robot.buses:
        for joint in robot.joints_of(bus):
            path = out / f"{bus.name}_{joint.name}.eds"
            path.write_text(eds(drive_dictionary(robot, joint, scenario.firmware)), encoding="ascii")
            written.append(path)
    return written


def _eds(options: argparse.Namespace) -> int:
    from hil.scenario import load

    scenario = load(options.scenario)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        for path in write_data_sheets(options.out, scenario):
            print(path)
    except OSError as error:
        raise UserError(f"--out {options.out}: {error.strerror}") from None
    return 0
