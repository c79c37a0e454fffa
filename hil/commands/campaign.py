"""``hil campaign FILE``: scenarios × faults × expectations, with a page and JUnit's XML."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hil.commands.arguments import positive, record_directory
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE

_MARKS = {"passed": "as expected", "weak": "weakness", "failed": "NOT AS EXPECTED"}


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("campaign", help="try a list of faults, each with what is expected of it")
    parser.add_argument("file", metavar="FILE", help="a built-in campaign (faults), or the path of a .toml file")
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="processes at once (1)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="directory of the results (default: runs/…)")
    parser.add_argument("--only", metavar="TEXT", help="only the rows whose names contain it")
    parser.add_argument("--video", action="store_true", help="a video of every run that is a failure")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_campaign)


def _campaign(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

    from hil.errors import UserError
    from hil.lab.campaign import run
    from hil.lab.campaign_file import read, text_of, trials
    from hil.report.campaign_page import write_junit, write_page
    from hil.run import versions

    campaign = read(options.file)
    if options.only is not None:
        rows = tuple(row for row in campaign.row if options.only in row.name)
        if not rows:
            raise UserError(f"--only {options.only}: no row of {options.file} has that in its name")
        campaign = campaign.model_copy(update={"row": rows})
    if options.video:
        from hil.report.video import require_rendering

        require_rendering()
    trials(campaign)  # a mistake is told before anything is created
    stamp = time.strftime("%Y%m%d-%H%M%S")
    out = record_directory(options.out, f"campaign-{campaign.name}-{stamp}")
    results = []
    console = Console(file=sys.stderr)
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(campaign.name, total=len(campaign.row) * len(campaign.seeds))
        for result in run(campaign, options.jobs, out, options.video):
            results.append(result)
            progress.advance(task)
    order = {row.name: n for n, row in enumerate(campaign.row)}
    results.sort(key=lambda result: (order[result.name], result.seed))
    write_page(out / "report.html", campaign, results, text_of(options.file), versions())
    write_junit(out / "junit.xml", campaign, results)
    failed = sum(result.status == "failed" for result in results)
    if options.json:
        table = [asdict(result) | {"record": result.record and str(result.record)} for result in results]
        print(json.dumps({"campaign": campaign.name, "failed": failed, "out": str(out), "results": table}))
    else:
        for result in results:
            print(f"{_MARKS[result.status]:16} {result.name}{_seed(result.seed, campaign.seeds)}: {result.sentence}")
        weak = sum(result.status == "weak" for result in results)
        print(f"{len(results)} trials, {failed} not as expected, {weak} known weaknesses")
        print(f"report      {out / 'report.html'}")
    return EXIT_UNSTABLE if failed else EXIT_STABLE


def _seed(seed: int, seeds: tuple[int, ...]) -> str:
    return f", seed {seed}" if len(seeds) > 1 else ""
