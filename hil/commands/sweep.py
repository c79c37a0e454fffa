"""``hil sweep SCENARIO --vary KEY=…``: a scenario at many points of its quantities, with several seeds; a table."""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from hil.commands.arguments import add_scenario, positive, scenario_of, seconds
from hil.errors import EXIT_STABLE, UserError


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("sweep", help="run a scenario at many points of its quantities, with several seeds")
    add_scenario(parser)
    parser.add_argument(
        "--vary", action="append", required=True, metavar="AXIS",
        help="KEY=LOW..HIGH:COUNT[:log] or KEY=VALUE,VALUE,…; with --sample KEY=LOW..HIGH[:log]; repeatable",
    )  # fmt: skip
    parser.add_argument("--sample", metavar="HOW", help="lhs:N or sobol:N points of the box instead of a grid")
    parser.add_argument("--seeds", type=positive, default=8, metavar="N", help="of every point, from 0 on (8)")
    parser.add_argument(
        "--at", default="2.5s", metavar="T",
        help="when a value that can be injected changes (2.5s); up to then such runs share one. 0s: from the start",
    )  # fmt: skip
    parser.add_argument(
        "--until-confident", action="store_true",
        help="no further seeds for a point once its verdict is clear (95 %% interval of the share of stable runs)",
    )  # fmt: skip
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes at once (default: one per core)")
    parser.add_argument("--cluster", metavar="tcp://HOST:PORT", help="run on the workers of this Dask scheduler")
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="directory of the table (default: runs/…); with the same command a sweep that was ended goes on there",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_sweep)


def _sweep(options: argparse.Namespace) -> int:
    from hil.lab.axes import axis
    from hil.lab.extras import require
    from hil.lab.sweep import TABLE_FILE, Plan, sweep
    from hil.lab.workers import default_jobs, on_cluster, parallel
    from hil.report.progress import Counter

    if options.cluster is not None and options.jobs is not None:
        raise UserError("--jobs and --cluster exclude each other: the cluster's workers are as many as they are")
    require("pyarrow.parquet", *(["distributed"] if options.cluster is not None else []))
    scenario = scenario_of(options)
    axes = tuple(axis(scenario, text, sampled=options.sample is not None) for text in options.vary)
    plan = Plan(
        scenario, axes, options.seeds, seconds("--at", options.at), options.sample, options.until_confident
    )  # fmt: skip
    out = options.out or Path("runs") / f"{scenario.name}-sweep-{time.strftime('%Y%m%d-%H%M%S')}"
    if options.cluster is not None:
        runner: Any = partial(on_cluster, address=options.cluster)
    else:
        runner = partial(parallel, jobs=options.jobs or default_jobs())
    began = time.monotonic()
    here = {"cells": 0, "simulated": 0.0, "cpu": 0.0}
    with Counter(f"{scenario.name}: sweep", len(plan.points) * plan.seeds, "runs", sys.stderr) as progress:

        def told(done: int, total: int, row: dict[str, Any] | None) -> None:
            if row is not None:
                here["cells"] += 1
                here["simulated"] += row["simulated_here"]
                here["cpu"] += row["cpu"]
            progress.show(done, f"{row['verdict']}" if row else "")

        try:
            rows = sweep(plan, out, runner, told)
        except KeyboardInterrupt:
            print(f"hil: ended; the same command with --out {out} goes on", file=sys.stderr)
            raise
    result = {
        "scenario": scenario.name,
        "points": len(plan.points),
        "seeds": plan.seeds,
        "runs": len(rows),
        "stable": sum(row["verdict"] == "stable" for row in rows.values()),
        "refused": sum(row["verdict"] == "refused" for row in rows.values()),
        "runs_now": here["cells"],
        "wall": time.monotonic() - began,
        "cpu": here["cpu"],
        "simulated": here["simulated"],
        "simulated_per_cpu": here["simulated"] / here["cpu"] if here["cpu"] else None,
        "table": str(out / TABLE_FILE),
    }
    if options.json:
        print(json.dumps(result, allow_nan=False))
    else:
        _print(result)
    return EXIT_STABLE


def _print(result: dict[str, Any]) -> None:
    print(f"{result['scenario']}: {result['points']} points, {result['seeds']} seeds, {result['runs']} runs")
    refused = f", {result['refused']} refused" if result["refused"] else ""
    print(f"stable      {result['stable']} of {result['runs']}{refused}")
    if result["runs_now"]:
        wall, cpu, simulated = result["wall"], result["cpu"], result["simulated"]
        print(f"now         {result['runs_now']} runs, {simulated:.0f} s simulated in {wall:.0f} s")
        print(f"speed       {simulated / cpu:.2f} s simulated per second of processor, {simulated / wall:.2f} of time")
    print(f"table       {result['table']}")
