"""``hil joint step``: step response of a joint's torque through the emulated drive, with published gains."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from hil.commands.joint_arguments import seconds
from hil.commands.joint_lab_arguments import add_arguments, directory, laws_of, quantity, setup_of
from hil.errors import EmulationError, UserError

if TYPE_CHECKING:
    from hil.joint_lab.setup import Setup
    from hil.joint_lab.step import StepResponse

_FIRMWARE = "firmware"
_BOTH = "both"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "step", help="step response of a joint's torque through the emulated drive",
        description="Step the torque command of the emulated drive over its bus: rise time, overshoot and steady error "
        "from the bus's log, for stance and swing gains of Kim 2018's Tables 2.1 and 7.1 or of the firmware.",
    )  # fmt: skip
    add_arguments(parser)
    parser.add_argument("--gains", choices=("stance", "swing", _BOTH), default=_BOTH, help="which set (both)")
    parser.add_argument("--stiction", choices=("on", "off", _BOTH), default=_BOTH, help="dry friction (both)")
    parser.add_argument(
        "--table", choices=("2.1", "7.1", _FIRMWARE), action="append", dest="tables",
        help="whose gains: of the tables (law cascade), or the firmware's own; repeatable (Hume: all, else firmware)",
    )  # fmt: skip
    parser.add_argument("--law", default="PID_m", metavar="LAW", help="for the firmware's own gains (PID_m)")
    parser.add_argument("--amplitude", default="20Nm", metavar="NM", help="of the step (20Nm)")
    parser.add_argument("--duration", default="0.5s", metavar="S", help="from the step to the end (0.5s)")
    parser.set_defaults(command=_step)


def _step(options: argparse.Namespace) -> int:
    from hil.joint_lab import plots, step

    setup, out = setup_of(options), directory(options.out)
    target, duration = quantity(options, "amplitude", "--amplitude", "N m"), seconds(options.duration)
    assert duration is not None
    if not 0 < target <= setup.firmware.torque_limit:
        raise UserError(
            f"--amplitude {options.amplitude}: expected more than 0 and at most firmware.torque_limit, "
            f"{setup.firmware.torque_limit:g} N m"
        )
    found: dict[plots.StepLabel, StepResponse] = {}
    rows: list[dict[str, Any]] = []
    for row, experiment in _experiments(options, setup):
        label = plots.StepLabel(row["gains"], row["set"], row["stiction"])
        log = (
            None if out is None else out / f"{label.gains}-{label.which}-{'with' if label.friction else 'no'}-friction"
        )
        try:
            response = step.run(experiment, target, duration, log)
        except (EmulationError, ValueError) as error:  # ValueError: the law refuses the gains
            rows.append({**row, "failed": str(error)})
        else:
            found[label] = response
            rows.append({**row, **_summary(response)})
    if out is not None and found:
        plots.steps(found, f"{setup.robot.name} {setup.joint.name}, load {options.load}", out / "step.png")
    if options.json:
        print(json.dumps(rows, allow_nan=False))
    else:
        _print(setup, options, target, rows)
    return 0


def _experiments(options: argparse.Namespace, setup: Setup) -> Iterator[tuple[dict[str, Any], Setup]]:
    from bus.messages import GainSet
    from hil.joint_lab import published
    from robots.actuators import SeriesElastic

    joint = setup.joint
    known = isinstance(joint.actuator, SeriesElastic) and joint.name in published.HUME["7.1"]["swing"]
    tables = options.tables or (["2.1", "7.1", _FIRMWARE] if known else [_FIRMWARE])
    sets = ("stance", "swing") if options.gains == _BOTH else (options.gains,)
    frictions = (True, False) if options.stiction == _BOTH else (options.stiction == "on",)
    own_laws = laws_of(options, setup)
    if len(own_laws) != 1:
        raise UserError(f"--law {options.law}: expected one torque loop")
    ((own_law, own),) = own_laws.items()
    for table in tables:
        if table != _FIRMWARE and not known:
            raise UserError(f"--table {table}: the tables are of Hume's joints, not of {setup.robot.name} {joint.name}")
        for which in sets:
            firmware, law = own.firmware.of_joint(joint.name), own_law
            if table != _FIRMWARE:
                law = "cascade"
                kd = getattr(firmware, which).kd
                gains = published.HUME[table][which][joint.name].of_cascade(joint, kd)
                firmware = firmware.model_copy(update={"law": law, which: gains})
            gain_set = GainSet.SWING if which == "swing" else GainSet.STANCE
            used = getattr(firmware, which)
            for friction in frictions:
                scale = (setup.friction_scale or 1.0) if friction else 0.0
                row = {
                    "gains": table, "set": which, "law": law, "stiction": friction,
                    "kp": used.kp, "ki": used.ki, "kd": used.kd,
                }  # fmt: skip
                yield row, setup._replace(firmware=firmware, gain_set=gain_set, friction_scale=scale)


def _summary(response: StepResponse) -> dict[str, Any]:
    return {
        "rise_time_s": response.rise_time,
        "overshoot": response.overshoot,
        "steady_error_nm": response.steady_error,
        "ripple_nm": response.ripple,
    }


def _print(setup: Setup, options: argparse.Namespace, target: float, rows: list[dict[str, Any]]) -> None:
    print(
        f"{setup.robot.name} {setup.joint.name}, load {options.load}: step of {target:g} N m at "
        f"{setup.firmware.rate:g} Hz"
    )
    print(
        f"{'gains':9} {'set':7} {'friction':8} {'law':9} {'kp':>6} {'ki':>6} {'kd':>6}   {'rise':>8} {'overshoot':>9} "
        f"{'steady error':>13} {'ripple':>9}"
    )
    for row in rows:
        head = (
            f"{row['gains']:9} {row['set']:7} {'on' if row['stiction'] else 'off':8} {row['law']:9} {row['kp']:6.2f} "
            f"{row['ki']:6.2f} {row['kd']:6.1f}"
        )
        if "failed" in row:
            print(f"{head}   {row['failed']}")
            continue
        rise = "–" if row["rise_time_s"] is None else f"{1e3 * row['rise_time_s']:.1f} ms"
        print(
            f"{head}   {rise:>8} {100 * row['overshoot']:7.1f} % {row['steady_error_nm']:9.2f} N m "
            f"{row['ripple_nm']:5.2f} N m"
        )
