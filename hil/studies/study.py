"""What a study is made of: parts, each a grid of runs or of linear loops in a directory of its own, where it goes on
when it was ended; and findings, which are worked out from all their answers."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hil.lab.axes import Axis, axis
from hil.lab.linear.questions import Follow, LinearPlan, answers
from hil.lab.quantity import quantity
from hil.lab.sweep import Plan, Row, Runner, sweep
from hil.lab.transplant import run_standing_cell
from hil.scenario import Scenario, load

Told = Callable[[int], None]  # is told how many of a part's answers there are


@dataclass(frozen=True)
class Answers:
    """axes of the part; rows: one per point, the last axis fastest."""

    scenario: Scenario
    axes: tuple[Axis, ...]
    rows: list[Row]

    def values(self, n: int) -> np.ndarray:
        """Of axis ``n``, SI."""
        return np.array(self.axes[n].values, float)

    def grid(self, name: str) -> np.ndarray:
        """``name`` of every row in the shape of the axes; what a row does not have is NaN."""
        found = [row.get(name) for row in self.rows]
        flat = [float("nan") if value is None else float(value) for value in found]
        return np.array(flat).reshape([len(a.values) for a in self.axes])


@dataclass(frozen=True)
class Part:
    """A scenario with settings, as --set takes them, and what is varied of it, as --vary takes it."""

    name: str
    scenario: str
    settings: tuple[str, ...]
    vary: tuple[str, ...]

    def loaded(self) -> tuple[Scenario, tuple[Axis, ...]]:
        scenario = load(self.scenario, list(self.settings))
        return scenario, tuple(axis(scenario, text) for text in self.vary)

    def count(self) -> int:
        """How many answers there will be at most."""
        raise NotImplementedError

    def run(self, directory: Path, runner: Runner, told: Told) -> Answers:
        """What is missing in ``directory`` is run. Raises UserError when that holds something else."""
        raise NotImplementedError


@dataclass(frozen=True)
class Runs(Part):
    """Whole runs with ``seeds`` seeds, from the start or, with ``at`` > 0, of a robot that stood up without what is
    varied, which changes then. A row: share of stable runs; how they end, with the most frequent reason of
    those that are not stable; medians of metrics over the seeds, by their names."""

    seeds: int = 1
    metrics: tuple[str, ...] = ()
    at: float = 0.0

    def _plan(self) -> Plan:
        scenario, axes = self.loaded()
        return Plan(scenario, axes, self.seeds, self.at)

    def count(self) -> int:
        return len(self._plan().points) * self.seeds

    def run(self, directory: Path, runner: Runner, told: Told) -> Answers:
        plan = self._plan()
        chosen = runner if not self.at else lambda _, calls: runner(run_standing_cell, calls)
        cells = sweep(plan, directory, chosen, lambda done, *_: told(done))
        rows = [self._of_point([cells[point, seed] for seed in range(self.seeds)]) for point in range(len(plan.points))]
        return Answers(plan.scenario, plan.axes, rows)

    def _of_point(self, runs: list[Row]) -> Row:
        failed = [run["reason"] for run in runs if run["verdict"] != "stable"]
        share = 1.0 - len(failed) / len(runs)
        medians = {}
        for name in self.metrics:
            known = [run["metrics"][name] for run in runs if run["metrics"].get(name) is not None]
            medians[name] = statistics.median(known) if known else None
        ends = f"{len(failed)} of {len(runs)}: {max(failed, key=failed.count)}" if failed else "stable"
        return {"share": share, "ends": ends, **medians}


@dataclass(frozen=True)
class Loops(Part):
    """The linear loop as it stands at ``at`` s. A row: as ``hil.lab.linear.questions`` has it.

    follow: key, nearest and farthest value, resolution of a quantity whose boundary is looked for.
    """

    at: float = 4.0
    follow: tuple[str, float, float, float] | None = None

    def _plan(self) -> LinearPlan:
        scenario, axes = self.loaded()
        follow = None if self.follow is None else Follow(quantity(scenario, self.follow[0]), *self.follow[1:])
        return LinearPlan(scenario, axes, self.at, follow)

    def count(self) -> int:
        return len(self._plan().points)

    def run(self, directory: Path, runner: Runner, told: Told) -> Answers:
        plan = self._plan()
        return Answers(plan.scenario, plan.axes, answers(plan, directory, runner, told))


Verdict = Literal["holds", "holds in part", "does not hold"]


@dataclass(frozen=True)
class Claim:
    """A claim of the source, whether it holds here, and by how much: whole sentences made of the numbers."""

    claim: str
    verdict: Verdict
    numbers: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Field:
    """A picture: ``values`` (len(y), len(x)) over a grid as colours between ``limits``, with ``texts`` on them, and
    curves of (x, y) by name."""

    name: str  # of its file
    title: str
    caption: str
    x_label: str
    y_label: str
    value_label: str
    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    texts: tuple[tuple[str, ...], ...]
    limits: tuple[float, float]
    colours: str
    logarithmic: tuple[bool, bool] = (False, False)
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    zero: bool = False  # draw where the values are 0


@dataclass(frozen=True)
class Findings:
    claims: tuple[Claim, ...]
    tables: tuple[Table, ...]
    fields: tuple[Field, ...]

    def record(self) -> dict[str, Any]:
        """For JSON: claims and tables."""
        return {
            "claims": [{"claim": c.claim, "verdict": c.verdict, "numbers": list(c.numbers)} for c in self.claims],
            "tables": [
                {"title": t.title, "head": list(t.head), "rows": [list(r) for r in t.rows]} for t in self.tables
            ],
        }


@dataclass(frozen=True)
class Study:
    """name; title; summary: one sentence. parts(quick): what is run. conclude: findings from the parts' answers by
    name."""

    name: str
    title: str
    summary: str
    parts: Callable[[bool], tuple[Part, ...]]
    conclude: Callable[[Mapping[str, Answers]], Findings]

    def run(
        self, directory: Path, runner: Runner, quick: bool = False, told: Callable[[str, int], None] = lambda *_: None
    ) -> tuple[dict[str, Answers], Findings]:
        """All parts, each below ``directory``, then the findings. told: (part, answers so far)."""
        found = {
            part.name: part.run(directory / part.name, runner, partial(told, part.name)) for part in self.parts(quick)
        }
        return found, self.conclude(found)
