"""Runs on either side of a boundary, run again with all that a record has: for a page to link to, and to look at."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.errors import EmulationError
from hil.lab.quantity import Quantity, Value, as_written, changed
from hil.record.journal import JOURNAL_FILE
from hil.report.html import Link
from hil.scenario import Scenario, complete

STABLE, UNSTABLE = "stable", "unstable"  # their directories


@dataclass(frozen=True)
class Pair:
    """Values in SI units by quantity: of the last run that is stable, and of the first that is not; of one seed."""

    seed: int
    stable: Mapping[Quantity, Value]
    unstable: Mapping[Quantity, Value]


def scenario_of(scenario: Scenario, at: float, values: Mapping[Quantity, Value]) -> Scenario:
    """``scenario`` with ``values`` (SI): injected at ``at`` s where that can be, else from the start."""
    fixed = {q.key: q.written(value) for q, value in values.items() if not q.injectable}
    data = as_written(changed(scenario, fixed) if fixed else scenario)
    injected = [
        {"at": f"{at!r} s", "key": q.key, "value": q.written(value)} for q, value in values.items() if q.injectable
    ]
    data["inject"] = [*data.get("inject", []), *injected]
    return complete(data, scenario.name)


def keep(
    directory: Path, scenario: Scenario, at: float, pair: Pair, page: Link, video: bool = False
) -> dict[str, dict[str, Any]]:
    """Run both, each into its own directory below ``directory``, and write ``compare.html`` there.

    page: that the runs belong to, as seen from ``directory``. Returns by name of the directory what run.json holds.
    Raises EmulationError when a run did not come to its end, or for a video without off-screen OpenGL.
    """
    from hil.analysis.comparison import side_by_side
    from hil.report.compare_page import write_comparison
    from hil.run import Request, run

    records = {}
    for name, values in ((STABLE, pair.stable), (UNSTABLE, pair.unstable)):
        out = directory / name
        if (out / JOURNAL_FILE).exists():  # what was kept by the same command before
            shutil.rmtree(out)
        up = Link(f"../{page.place}", page.text)
        again = scenario_of(scenario, at, values)
        outcome = run(Request(again, pair.seed, "inline", out=out, video=video, part_of=up))
        if outcome.record["verdict"] == "failed":
            raise EmulationError(f"the run in {out} did not get to its end: {outcome.reason}")
        records[name] = outcome.record
    write_comparison(directory, side_by_side([directory / STABLE, directory / UNSTABLE]), part_of=page)
    return records


def section(directory: Path, told: Mapping[str, str]) -> str:
    """HTML about what was kept below ``directory``; nothing if nothing was. ``told``: what is to be said of each."""
    from hil.report.html import film, run_link

    runs = [directory / name for name in (STABLE, UNSTABLE) if (directory / name / "run.json").exists()]
    if not runs or any(run.name not in told for run in runs):
        return ""
    items = "".join(f"<li>{run_link(directory, run, told[run.name])}{film(directory, run)}</li>" for run in runs)
    return f"<h2>Either side of the boundary</h2><ul>{items}</ul><p>{Link('compare.html', 'One over the other')}</p>"
