"""``hil linearise SCENARIO``: the whole sampled loop as a linear map, its modes, and where a quantity upsets them."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import add_scenario, scenario_of, seconds
from hil.commands.margin import ends_of
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, UserError

if TYPE_CHECKING:
    from hil.lab.quantity import Quantity

_TOLD = 12  # modes
_ABOUT = 12  # linearisations that a prediction takes


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser(
        "linearise", help="modes of the linearised closed loop, and where a quantity makes them unstable",
        description="The whole sampled loop (world, drives, buses, links, controller) without dry friction, noise and "
        "rounding, linearised about the standing robot by displacing its states in the emulation.",
    )  # fmt: skip
    add_scenario(parser)
    parser.add_argument("--at", default="5s", metavar="T", help="when (5s): both feet must stand")
    parser.add_argument("--of", metavar="KEY", help="also follow this quantity to where the loop becomes unstable")
    parser.add_argument(
        "--range", metavar="NEAR..FAR", dest="ends", help="with --of: from a stable value, and how far at most"
    )
    parser.add_argument("--resolution", metavar="STEP", help="with --of: how fine (default: a 100th of the way)")
    parser.add_argument("--json", action="store_true", help="print one JSON object, SI units, and nothing else")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write linearise.json, its plots and a page there")
    parser.set_defaults(command=_linearise)


def _linearise(options: argparse.Namespace) -> int:
    from hil.lab.linear.operating_point import OperatingPoint
    from hil.lab.linear.prediction import predict
    from hil.lab.margin import Search, checked
    from hil.lab.quantity import quantity
    from hil.report.progress import Counter

    if options.of is None and (options.ends or options.resolution):
        raise UserError("--range and --resolution go with --of")
    scenario = scenario_of(options)
    at = seconds("--at", options.at)
    search = None
    if options.of is not None:
        varied = quantity(scenario, options.of)
        near, far = (None, None) if options.ends is None else ends_of(options.ends, varied)
        fine = None if options.resolution is None else float(varied.parse(options.resolution))
        search = checked(Search(scenario, varied, at, near, far, fine))
    with (
        Counter(scenario.name, 2 if search is None else _ABOUT, "linearisations", sys.stderr) as progress,
        OperatingPoint(scenario, at) as point,
    ):
        found = point.linearise()
        progress.show(1)
        half = point.linearise(scale=0.5 * found.scale)
        progress.show(2)
        prediction = None if search is None else predict(point, search, lambda steps: progress.show(2 + len(steps)))
    record = {
        "scenario": scenario.name,
        "at": at,
        "period": found.model.period,
        **found.record(),
        "convergence": found.change(half),
        "doubt": found.doubt(half),
    }
    if search is not None and prediction is not None:
        of = search.quantity
        record["prediction"] = {"of": of.key, "unit": of.unit, "nominal": of.nominal, **prediction.record()}
    if options.out is not None:
        from hil.report.linear_page import write_linear

        write_linear(options.out, record, None if search is None else search.quantity)
    if options.json:
        print(json.dumps(record, allow_nan=False))
    else:
        _print(record, None if search is None else search.quantity)
        if options.out is not None:
            print(f"report      {options.out / 'linearise.html'}")
    return EXIT_STABLE if found.growth < 0.0 else EXIT_UNSTABLE


def _print(record: dict[str, Any], quantity: Quantity | None) -> None:
    from hil.report.linear_page import sentences

    print(f"{'growth':>10} {'frequency':>11} {'damping':>8}   takes part")
    moving = [mode for mode in record["modes"] if not mode["still"]]
    for mode in moving[:_TOLD]:
        shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in list(mode["participation"].items())[:4])
        print(f"{mode['growth']:>8.2f}/s {mode['frequency']:>8.2f} Hz {mode['damping']:>8.3f}   {shares}")
    still = len(record["modes"]) - len(moving)
    print(f"left out: {still} that drift slowly, if at all (feet, integrals), {len(moving) - _TOLD} that fade faster")
    print()
    for line in sentences(record, quantity):
        print(line)
