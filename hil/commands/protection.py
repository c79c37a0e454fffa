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
    parser.add_argument(
        "--margins", metavar="SCENARIO", help="instead: run it, and show how near its drives come to their limits"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help="of that run; repeatable"
    )
    parser.add_argument(
        "--joint", default="left_knee", metavar="NAME", help="whose drive is tried (left_knee, whose times these are)"
    )
    parser.add_argument("--seed", type=natural, default=1, metavar="N", help="of trials or run (1)")
    parser.add_argument("--markdown", action="store_true", help="print the table as docs/protection.md has it")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_protection)


def _protection(options: argparse.Namespace) -> int:
    from hil.analysis.fault_cases import CASES, markdown, rows

    if options.markdown:
        print(markdown(), end="")
        return EXIT_STABLE
    if options.margins is not None:
        return _margins(options)
    trials = _measure(options) if options.measure else []
    table = rows()
    if options.measure:
        table = [(*table[0], "seen")] + [(*row, _seen(trial)) for row, trial in zip(table[1:], trials, strict=True)]
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
        _print(table)
    return EXIT_STABLE if all(trial.good for trial in trials) else EXIT_UNSTABLE


def _print(table: list[tuple[str, ...]]) -> None:
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    for row in table:
        print("  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())


def _margins(options: argparse.Namespace) -> int:
    from hil.analysis.fault_margins import margins, table
    from hil.scenario import load

    record, peaks = margins(load(options.margins, options.settings), options.seed)
    if options.json:
        shares = {joint: [float(share) for share in peak] for joint, peak in peaks.items()}
        print(json.dumps({"verdict": record["verdict"], "reason": record["reason"], "levels": shares}))
    else:
        print(f"{record['scenario']}, seed {record['seed']}: {record['verdict']}, {record['reason']}")
        _print(table(peaks))
    return EXIT_STABLE if record["verdict"] == "stable" else EXIT_UNSTABLE


def _measure(options: argparse.Namespace) -> list[Trial]:
    from hil.analysis.fault_cases import CASES
    from hil.analysis.fault_trial import trial_bench

    with trial_bench(options.seed, options.joint) as bench:
        return [bench.run(case) for case in CASES]


def _seen(trial: Trial) -> str:
    if trial.safe_after is None:
        return "not noticed"
    return f"{1e3 * trial.safe_after:.1f} ms" + ("" if trial.good else f", but {trial.what_is_wrong()}")
