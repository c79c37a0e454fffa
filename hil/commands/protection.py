"""``hil protection``: every fault of a drive, what it does about it, and the time until its output is safe."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import natural
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE

if TYPE_CHECKING:
    from hil.analysis.fault_trial import Trial


def add_parser(commands: Any) -> None:
    """The subcommand ``protection``."""
    parser = commands.add_parser(
        "protection", help="what the drives do about each fault, and how fast",
        description="The faults that a drive's protection knows. With --measure each is brought about in a standing "
        "robot.",
    )  # fmt: skip
    parser.add_argument("--measure", action="store_true", help="try each; exit status 1 when one is not as here")
    parser.add_argument("--joint", default="left_knee", metavar="NAME", help="whose drive is tried (left_knee)")
    parser.add_argument("--seed", type=natural, default=1, metavar="N", help="of the trials (1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_protection)


def _protection(options: argparse.Namespace) -> int:
    from hil.analysis.fault_cases import CASES, rows

    trials = _measure(options) if options.measure else []
    table = rows()
    if options.measure:
        table = [(*table[0], "seen")] + [
            (*row, _seen(trial)) for row, trial in zip(table[1:], trials, strict=True)
        ]
    if options.json:
        keys = [name.replace(" ", "_") for name in table[0]]
        cases = [
            dict(zip(keys, row, strict=True)) | {"name": case.name, "within_s": case.within}
            for row, case in zip(table[1:], CASES, strict=True)
        ]
        for case, trial in zip(cases, trials, strict=False):
            case |= {"safe_after_s": trial.safe_after, "as_it_should": trial.good}
        print(json.dumps({"cases": cases}))
    else:
        widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
        for row in table:
            print("  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    return EXIT_STABLE if all(trial.good for trial in trials) else EXIT_UNSTABLE


def _measure(options: argparse.Namespace) -> list[Trial]:
    from hil.analysis.fault_cases import CASES
    from hil.analysis.fault_trial import trial_bench

    with trial_bench(options.seed, options.joint) as bench:
        return [bench.run(case) for case in CASES]


def _seen(trial: Trial) -> str:
    if trial.safe_after is None:
        return "not noticed"
    return f"{1e3 * trial.safe_after:.1f} ms" + ("" if trial.good else f", but {trial.what_is_wrong()}")
