"""``hil steps DIR``: the steps of a recorded run, one by one, and their pictures as files."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import record_directory
from hil.errors import EXIT_STABLE, UserError

if TYPE_CHECKING:  # the command line starts without it
    from hil.record.recorded import Recorded


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("steps", help="list the steps of a recorded run; draw them for a paper")
    parser.add_argument("run", type=Path, metavar="DIR", help="the record of a run")
    parser.add_argument("--out", type=Path, metavar="NEW", help="write the plots there, as steps-….png")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else, SI units")
    parser.set_defaults(command=_steps)


def _steps(options: argparse.Namespace) -> int:
    from hil.record.recorded import read_run

    run = read_run(options.run)
    found = list_steps(run)
    if not found:
        raise UserError(
            f"{options.run}: no foot has landed in this run of {run.scenario.name}; `hil run balance` steps"
        )
    files = _draw(run, record_directory(options.out)) if options.out is not None else []
    if options.json:
        print(json.dumps({"steps": found, "pictures": [str(file) for file in files]}, allow_nan=False))
        return EXIT_STABLE
    print(
        "step  swing foot    touch-down s   takes ms   landing ms   error x, y cm   torque step, N m: lift  touch-down"
    )
    for step in found:
        print(
            f"{step['number']:4}  {step['swing'].replace('_', ' '):14}{step['touch_down']:10.3f}"
            f"{_shown(step['duration'], 1e3, 0):>13}{_shown(step['durations'].get('landing'), 1e3, 0):>12}"
            f"{_shown(step['error'][0], 100, 2):>11}{_shown(step['error'][1], 100, 2):>8}"
            f"{_shown(step['torque_step_at_lift'], 1, 1):>20}{_shown(step['torque_step_at_touchdown'], 1, 1):>11}"
        )
    for file in files:
        print(f"written     {file}")
    return EXIT_STABLE


def list_steps(run: Recorded) -> list[dict[str, Any]]:
    """Every step whose foot has landed, ready for JSON: SI units, None where a value is unknown."""
    from central_controller.behaviours.step import State
    from hil.analysis.stepping import LIFT, TOUCHDOWN, torque_changes, torque_step
    from hil.analysis.steps import PHASES, steps_of

    controller = run.tables["controller"]
    steps = steps_of(controller, run.tables["world"])
    changes = torque_changes(controller)
    listed = []
    for step in steps:
        durations = step.durations(controller.seconds)
        listed.append({
            "number": step.number,
            "swing": step.swing,
            "touch_down": float(controller.seconds[step.began[State.LOADING]]),
            "durations": {state.name.lower(): duration for state, duration in durations.items()},
            "duration": sum(durations.values()) if len(durations) == len(PHASES) else None,
            "planned": [_known(value) for value in step.planned],
            "landed": [_known(value) for value in step.landed],
            "error": [_known(value) for value in step.error],
            "torque_step_at_lift": torque_step(controller, changes, step, LIFT),
            "torque_step_at_touchdown": torque_step(controller, changes, step, TOUCHDOWN),
        })  # fmt: skip
    return listed


def _draw(run: Recorded, directory: Path) -> list[Path]:
    from hil.report.stepping import figures

    files = []
    for name, (_, _, figure) in figures(run.configuration, run.tables).items():
        files.append(directory / f"steps-{name}.png")
        figure.savefig(files[-1], dpi=120)
    return files


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _shown(value: float | None, scale: float, digits: int) -> str:
    return "–" if value is None else f"{value * scale:.{digits}f}"
