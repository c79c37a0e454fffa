"""``hil linearise SCENARIO``: the whole sampled loop as a linear map, its modes, and where a quantity upsets them."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import add_scenario, scenario_of, seconds
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, UserError

if TYPE_CHECKING:
    from hil.lab.linear.linearisation import Linearisation

_TOLD = 12  # modes


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
    from hil.lab.linear.prediction import Reach, predict
    from hil.lab.quantity import quantity
    from hil.report.progress import Counter

    if options.of is None and (options.ends or options.resolution):
        raise UserError("--range and --resolution go with --of")
    scenario = scenario_of(options)
    at = seconds("--at", options.at)
    varied = None if options.of is None else quantity(scenario, options.of)
    reach = None if varied is None else Reach.of(varied, options.ends, options.resolution)
    with (
        Counter(scenario.name, 2 if reach is None else None, "linearisations", sys.stderr) as progress,
        OperatingPoint(scenario, at) as point,
    ):
        found = point.linearise()
        progress.advance()
        half = point.linearise(scale=0.5)
        progress.advance()
        prediction = None if reach is None else predict(point, reach, lambda _: progress.advance())
    record = {
        "scenario": scenario.name,
        "at": at,
        "period": found.model.period,
        **found.record(),
        "convergence": _convergence(found, half),
    }
    if varied is not None and prediction is not None:
        record["prediction"] = {
            "of": varied.key, "unit": varied.unit, "nominal": varied.nominal, **prediction.record(),
        }  # fmt: skip
    if options.out is not None:
        from hil.report.linear_page import write_linear

        write_linear(options.out, record)
    if options.json:
        print(json.dumps(record, allow_nan=False))
    else:
        _print(record)
        if options.out is not None:
            print(f"report      {options.out / 'linearise.html'}")
    return EXIT_STABLE if found.growth < 0.0 else EXIT_UNSTABLE


def _convergence(found: Linearisation, half: Linearisation) -> dict[str, float]:
    """How far the modes that matter move when all displacements are halved: largest change [1/s] of growth and
    angular frequency."""
    mode = found.dominant
    waves = [m for m in found.modes if m.frequency > 0.5 and m.growth > -50.0] or [mode]
    return {
        "noise": found.noise,
        "largest_change": max(abs(complex(m.growth - o.growth, 6.283185307179586 * (m.frequency - o.frequency)))
                              for m in waves for o in [half.nearest(m)]),
    }  # fmt: skip
