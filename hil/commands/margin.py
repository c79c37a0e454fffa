"""``hil margin SCENARIO --of KEY``: the largest value with which it is stable, for several seeds, by bisection."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import add_scenario, positive, scenario_of, seconds
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, UserError

if TYPE_CHECKING:
    from hil.lab.linear.prediction import Prediction
    from hil.lab.margin import Search
    from hil.lab.quantity import Quantity


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("margin", help="the largest value of a quantity with which a scenario is stable")
    add_scenario(parser)
    parser.add_argument("--of", required=True, metavar="KEY", help="what to vary, e.g. link.command.delay")
    parser.add_argument(
        "--range", metavar="NEAR..FAR", dest="ends",
        help="from a stable value to one that is not, e.g. 0ms..30ms, or 1..0.1 (default: found by doubling)",
    )  # fmt: skip
    parser.add_argument("--seeds", type=positive, default=4, metavar="N", help="how many, from 0 on (4)")
    parser.add_argument(
        "--at", default="5s", metavar="T",
        help="when a value that can be injected changes (5s): what is found is the margin of what goes on then",
    )  # fmt: skip
    parser.add_argument("--resolution", metavar="STEP", help="how fine, e.g. 0.1ms (default: a 64th of the margin)")
    parser.add_argument(
        "--predict", action="store_true", help="also where the linearised loop becomes unstable (see `hil linearise`)"
    )
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes at once (default: one per core)")
    parser.add_argument("--json", action="store_true", help="print one JSON object, SI units, and nothing else")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write margin.json, margin.png and margin.html there")
    parser.add_argument(
        "--keep",
        action="store_true",
        help="also the records of the last stable and the first unstable run, below --out",
    )
    parser.add_argument("--video", action="store_true", help="--keep, with their videos")
    parser.set_defaults(command=_margin)


def ends_of(text: str, quantity: Quantity) -> tuple[float, float]:
    """``NEAR..FAR`` in SI units. Raises UserError."""
    near, separator, far = text.partition("..")
    if not separator or not near or not far:
        raise UserError(f"--range {text}: expected NEAR..FAR, for example 0ms..30ms")
    return float(quantity.parse(near)), float(quantity.parse(far))


def _margin(options: argparse.Namespace) -> int:
    from hil.lab.kept import keep
    from hil.lab.margin import Search, boundary_pair, checked, margins, summary
    from hil.lab.quantity import quantity
    from hil.lab.workers import default_jobs
    from hil.report.html import Link
    from hil.report.progress import Counter

    if (options.keep or options.video) and options.out is None:
        raise UserError(f"--{'video' if options.video else 'keep'} needs --out DIR, below which the runs are kept")
    if options.video:
        from hil.report.video import require_rendering

        require_rendering()
    scenario = scenario_of(options)
    varied = quantity(scenario, options.of)
    near = far = resolution = None
    if varied.numeric:
        near, far = (None, None) if options.ends is None else ends_of(options.ends, varied)
        resolution = None if options.resolution is None else float(varied.parse(options.resolution))
    search = checked(Search(scenario, varied, seconds("--at", options.at), near, far, resolution))
    jobs = options.jobs or default_jobs()
    prediction = _predicted(search) if options.predict else None  # first: it tells at once where there can be none
    with Counter(f"{scenario.name}: {varied.key}", options.seeds, "seeds", sys.stderr) as progress:
        found = margins(search, range(options.seeds), jobs, progress.show)
    result = summary(search, found)
    if prediction is not None:
        result |= _beside(prediction, search, result)
    if options.out is not None:
        from hil.report.margin_page import write_margin

        pair = boundary_pair(result, varied) if options.keep or options.video else None
        if pair is not None:
            keep(
                options.out,
                scenario,
                search.at,
                pair,
                Link("margin.html", f"the margin of {varied.key}"),
                options.video,
            )
        write_margin(options.out, result, varied)
    if options.json:
        print(json.dumps(result, allow_nan=False))
    else:
        _print(result, varied)
        if options.out is not None:
            print(f"report      {options.out / 'margin.html'}")
    return EXIT_UNSTABLE if result["unstable_at_start"] == len(found) else EXIT_STABLE


def _predicted(search: Search) -> Prediction:
    """What the linear loop says of the same."""
    from hil.lab.linear.prediction import predicted
    from hil.report.progress import Counter

    with Counter("the linear loop", 10, "linearisations", sys.stderr) as progress:
        return predicted(search, lambda steps: progress.show(len(steps)))


def _beside(prediction: Prediction, search: Search, result: dict[str, Any]) -> dict[str, Any]:
    """The prediction for JSON, and why it differs from what was found where it does."""
    from hil.lab.linear.prediction import parting

    ended = [run for seed in result["per_seed"] for run in seed["tried"] if run["value"] == seed["unstable"]]
    reasons, first = [run["reason"] for run in ended], [run["came_first"] for run in ended]
    record = prediction.record()
    return {
        "predicted": record.pop("predicted"),
        "doubt": record.pop("doubt"),
        "parting": parting(search, prediction, result["margin"], reasons, first),
        "linear": record,
    }


def _print(result: dict[str, Any], quantity: Quantity) -> None:
    from hil.report.margin_page import sentences

    shown = quantity.shown
    columns = "".join(f"{name:>12}" for name in ("CoM error", "int. force", "foot slip", "friction"))
    print(f"{'seed':>4} {quantity.key:>20}{columns}  force oscillates   verdict")
    for seed in result["per_seed"]:
        for run in sorted(seed["tried"], key=lambda run: run["value"]):
            print(f"{seed['seed']:>4} {shown(run['value']):>20}{_numbers(run['metrics'])}   {run['reason']}")
    print()
    for line in sentences(result, quantity):
        print(line)


def _numbers(metrics: dict[str, Any]) -> str:
    def cell(name: str, scale: float, unit: str) -> str:
        value = metrics.get(name)
        return f"{'–' if value is None else f'{scale * value:.2f} {unit}':>12}"

    cells = [
        cell("com_error_max", 1e3, "mm"),
        cell("internal_force_error", 100, "%"),
        cell("foot_slip_max", 1e3, "mm"),
        cell("friction_used_max", 100, "%"),
    ]
    wave = (metrics.get("oscillation") or {}).get("internal_force")
    wave_text = f"{wave['amplitude']:.1f} N {wave['frequency']:.1f} Hz" if wave else "–"
    return "".join(cells) + f"  {wave_text:>16}"
