"""The file with the offsets of a robot's absolute encoders, and how a scenario takes them over.

    robot = "hume"
    [encoder_offset]          # what the absolute encoder reads with the joint at 0
    left_knee = "0.0513 rad"

``firmware.calibration = "FILE"`` of a scenario stands for ``firmware.joints.JOINT.encoder_offset`` of every joint in
it, so that what a run records does not depend on the file any more.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hil import schema
from hil.errors import UserError
from robots.description import Robot
from robots.quantities import Config, Radians

KEY = "calibration"


class Calibration(Config):
    """The content of a file."""

    robot: str
    encoder_offset: dict[str, Radians]


def read(path: Path) -> Calibration:
    """The calibration in the file at ``path``. Raises UserError naming file, key and what would be right."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:  # not UTF-8, not TOML
        raise UserError(f"{path}: not valid TOML ({error})") from None
    try:
        return Calibration.model_validate(data)
    except ValidationError as error:
        raise UserError(f"{path}: {schema.sentence(error.errors()[0], Calibration)}") from None


def write(path: Path, robot: Robot, offsets: Mapping[str, float], how: str) -> None:
    """Write the ``offsets`` [rad] by joint; ``how`` they were found goes on top as a comment."""
    lines = [f"# {how}", f'robot = "{robot.name}"', "", "[encoder_offset]"]
    lines += [f'{name} = "{offsets[name]:.6f} rad"' for name in robot.joint_names if name in offsets]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def take_over(data: dict[str, Any], robot: Robot, folder: Path) -> None:
    """Replace ``firmware.calibration`` of a scenario's ``data`` by the offsets in that file, relative to ``folder``.

    An offset that the scenario itself gives stays. Raises UserError for a file that does not fit the robot.
    """
    firmware = data.get("firmware")
    if not isinstance(firmware, dict) or KEY not in firmware:
        return
    named = firmware.pop(KEY)
    if not isinstance(named, str):
        raise UserError(f"firmware.{KEY} = {named!r}: expected the path of a file, in quotes")
    path = folder / named
    calibration = read(path)
    if calibration.robot != robot.name:
        raise UserError(f"{path}: it is of robot {calibration.robot!r}, not of {robot.name!r}")
    joints = firmware.setdefault("joints", {})
    for name, offset in calibration.encoder_offset.items():
        if name not in robot.joint_names:
            raise UserError(
                f"{path}: unknown key {f'encoder_offset.{name}'!r}"
                f"{schema.nearest(name, robot.joint_names, 'encoder_offset')}"
            )
        own = joints.setdefault(name, {}) if isinstance(joints, dict) else None
        if isinstance(own, dict):  # else the scenario is wrong there, which its own check tells
            own.setdefault("encoder_offset", f"{offset!r} rad")
