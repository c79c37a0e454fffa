"""``hil estimators``: how far off the estimators are on their benches, whether they know it, and what they cost."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from hil.commands.arguments import natural
from hil.errors import EXIT_STABLE, UserError

_DURATION = 3.0  # s


def add_parser(commands: Any) -> None:
    """The subcommand ``estimators``."""
    parser = commands.add_parser(
        "estimators", help="errors, consistency and cost of the estimators on their benches",
        description="The four foot filters on the two-joint chain of Kim 2018 §6.2.1 with its errors, the light one "
        "on Hume that steps, the orientation filter over a foot that rocks, the planner's pendulum observer; and what "
        "they cost of a servo tick.",
    )  # fmt: skip
    parser.add_argument("--seeds", type=natural, default=4, metavar="N", help="runs of each bench (4)")
    parser.add_argument("--duration", metavar="S", help="of each run (3s)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write estimators.json and plots of the foot filters there"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_estimators)


def _estimators(options: argparse.Namespace) -> int:
    from hil.commands.joint_arguments import seconds
    from hil.commands.joint_lab_arguments import directory

    if options.seeds < 1:
        raise UserError("--seeds 0: expected at least 1")
    duration = seconds(options.duration) or _DURATION
    if not 2.0 <= duration <= 60.0:
        raise UserError(f"--duration {options.duration}: expected 2s to 60s: half a second settles, the rest is judged")
    out = directory(options.out)
    from hil.estimator_lab.report import as_json, lines, measure

    results = measure(options.seeds, duration)
    if options.json:
        print(json.dumps(as_json(results)))
    else:
        print("\n".join(lines(results)))
    if out is not None:
        from hil.estimator_lab.plots import foot_position

        (out / "estimators.json").write_text(json.dumps(as_json(results), indent=1), encoding="utf-8")
        for name, comparison in results.feet.items():
            foot_position(
                comparison,
                f"Foot position: {name}",
                out / f"foot-position-{name.replace(',', '').replace(' ', '-')}.png",
            )
    return EXIT_STABLE
