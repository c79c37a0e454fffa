"""Sweeps: a scenario at many points of its quantities, with several seeds, on this machine or on a cluster.

A *cell* is one run: a point and a seed. Values of injectable quantities are injected at ``Plan.at`` into a system that
has settled, which cells of one seed share that differ by such values only: a worker keeps the last one that it had.
What a cell gives does not depend on where or in which order cells run, so every way of running gives the same table.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hil.errors import UserError
from hil.lab.axes import Axis, points, written
from hil.lab.cell_journal import Cell, CellJournal, write_durably
from hil.lab.experiment import Outcome, Trials
from hil.lab.quantity import Quantity, Value, changed
from hil.lab.statistics import share_interval
from hil.scenario import Scenario

TABLE_FILE = "table.parquet"
_METADATA = b"hil.sweep"

Row = dict[str, Any]
Runner = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[Any]]


@dataclass(frozen=True)
class Plan:
    """What to sweep. ``until_confident``: leave out further seeds of a point whose verdict is clear."""

    scenario: Scenario
    axes: tuple[Axis, ...]
    seeds: int
    at: float
    sample: str | None = None
    until_confident: bool = False

    @cached_property
    def points(self) -> list[tuple[Value, ...]]:
        """The points, in the order of the axes. Raises UserError."""
        return points(self.axes, self.sample)

    def check(self) -> None:
        """Raise UserError when there is a point that the scenario does not take."""
        if any(a.quantity.injectable for a in self.axes) and not self.at < self.scenario.duration:
            raise UserError(f"--at {self.at:g} s: the scenario ends at {self.scenario.duration:g} s")
        for fixed in dict.fromkeys(map(self.fixed, self.points)):
            changed(self.scenario, dict(fixed))

    def fixed(self, point: tuple[Value, ...]) -> tuple[tuple[str, Value], ...]:
        """What of ``point`` holds from the start, as written: cells that have it in common share the settled part."""
        return tuple(
            (a.quantity.key, a.quantity.written(value))
            for a, value in zip(self.axes, point, strict=True)
            if not a.quantity.injectable
        )

    def manifest(self) -> dict[str, Any]:
        """All that determines the table, and the machine that began it."""
        from hil.run import versions

        machine = versions()
        return {
            "scenario": self.scenario.model_dump(mode="json"),
            "axes": written(self.axes),
            "sample": self.sample,
            "points": len(self.points),
            "seeds": self.seeds,
            "at": self.at,
            "until_confident": self.until_confident,
            "versions": {name: machine[name] for name in machine if name not in ("python", "platform", "compiler")},
            "machine": {name: machine[name] for name in ("python", "platform", "compiler")},
        }

    def rounds(self, rows: dict[Cell, Row]) -> Iterator[list[Cell]]:
        """Cells still to be run, given those in ``rows``, which grows: all at once, or seed after seed while points
        are in doubt. In the order in which cells that share a settled part follow each other."""
        everything = range(len(self.points))
        if not self.until_confident:
            yield self._order(everything, range(self.seeds), rows)
            return
        for seed in range(self.seeds):
            doubtful = [p for p in everything if not _decided(p, seed, rows)]
            yield self._order(doubtful, [seed], rows)

    def _order(self, which: Iterable[int], seeds: Iterable[int], rows: dict[Cell, Row]) -> list[Cell]:
        groups = {fixed: n for n, fixed in enumerate(dict.fromkeys(map(self.fixed, self.points)))}
        ordered = sorted(which, key=lambda p: (groups[self.fixed(self.points[p])], p))
        return [(p, seed) for seed in seeds for p in ordered if (p, seed) not in rows]

    def call(self, cell: Cell) -> tuple[Scenario, float, dict[Quantity, Value], Cell]:
        """The arguments of ``run_cell``."""
        values = zip((a.quantity for a in self.axes), self.points[cell[0]], strict=True)
        return self.scenario, self.at, dict(values), cell


def _decided(point: int, seeds: int, rows: dict[Cell, Row]) -> bool:
    """Whether some of the first ``seeds`` verdicts of ``point`` were enough to tell on which side of ½ its share of
    stable runs lies (each look by itself, at the interval's confidence)."""
    stable = 0
    for n in range(1, seeds + 1):
        stable += rows[point, n - 1]["verdict"] == "stable"
        low, high, _ = share_interval(stable, n)
        if low > 0.5 or high < 0.5:
            return True
    return False


_kept = threading.local()  # the Trials of this thread: a worker's settled system waits for its next cell


def run_cell(scenario: Scenario, at: float, values: dict[Quantity, Value], cell: Cell) -> tuple[Cell, Row]:
    """Run one cell. The row: verdict, reason, metrics, digest, and what it cost (``simulated_here``, ``cpu``: s)."""
    trials = getattr(_kept, "trials", None)
    if trials is None or trials.at != at or trials.scenario != scenario:
        if trials is not None:
            trials.close()
        trials = _kept.trials = Trials(scenario, at)
    before, began = trials.simulated, time.thread_time()
    try:
        found = trials.outcome(values, cell[1])
        row = row_of(found)
    except UserError as error:  # a stance that cannot be: known only when the robot is put there
        row = {"verdict": "refused", "reason": str(error), "simulated": 0.0, "metrics": {}, "digest": None}
    return cell, {**row, "simulated_here": trials.simulated - before, "cpu": time.thread_time() - began}


def row_of(found: Outcome) -> Row:
    """A row, without what it cost."""
    return {
        "verdict": "stable" if found.stable else "unstable",
        "reason": found.reason,
        "came_first": found.came_first,
        "simulated": found.simulated,
        "metrics": dict(flat(found.metrics)),
        "digest": found.digest,
    }


def flat(metrics: dict[str, Any], path: str = "") -> Iterator[tuple[str, float | None]]:
    """The numbers of nested ``metrics`` by their paths, with dots; those of an absent table are left out."""
    for name, value in metrics.items():
        if isinstance(value, dict):
            yield from flat(value, f"{path}{name}.")
        elif value is None or isinstance(value, int | float):
            yield f"{path}{name}", value


def sweep(
    plan: Plan, directory: Path, runner: Runner, told: Callable[[int, int, Row | None], None] = lambda *_: None
) -> dict[Cell, Row]:
    """Run what is missing in ``directory``, then write its table. Returns the row of every cell.

    told: (cells done, cells in all as far as is known, the newest row), at the start and after each.
    """
    plan.check()
    with CellJournal(directory, plan.manifest()) as journal:
        total = len(plan.points) * plan.seeds
        told(len(journal.rows), total, None)
        for missing in plan.rounds(journal.rows):
            for cell, row in runner(run_cell, [plan.call(cell) for cell in missing]):
                journal.append(cell, row)
                told(len(journal.rows), total, row)
        _write_table(plan, directory, journal.rows)
        return dict(journal.rows)


def _write_table(plan: Plan, directory: Path, rows: dict[Cell, Row]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    cells = sorted(rows)
    types = {"number": pa.float64(), "integer": pa.int64(), "flag": pa.bool_(), "text": pa.string()}
    fields, columns = [pa.field("point", pa.int64())], [[point for point, _ in cells]]

    def add(name: str, kind: Any, values: list[Any], unit: str = "") -> None:
        fields.append(pa.field(name, kind, metadata={"unit": unit} if unit else None))
        columns.append(values)

    for n, a in enumerate(plan.axes):
        add(a.quantity.key, types[a.quantity.kind], [plan.points[p][n] for p, _ in cells], a.quantity.unit)
    add("seed", pa.int64(), [seed for _, seed in cells])
    for name in ("verdict", "reason", "came_first", "digest"):
        add(name, pa.string(), [rows[cell].get(name) for cell in cells])
    add("simulated", pa.float64(), [rows[cell]["simulated"] for cell in cells], "s")
    # those that some run has: "oscillation.pitch" is none where "oscillation.pitch.growth" might be
    found = {name for cell in cells for name, value in rows[cell]["metrics"].items() if value is not None}
    for name in sorted(found):
        add(f"metrics.{name}", pa.float64(), [_number(rows[cell]["metrics"].get(name)) for cell in cells])
    manifest = plan.manifest()
    manifest.pop("machine")
    schema = pa.schema(fields, metadata={_METADATA: json.dumps(manifest).encode()})
    table = pa.table(columns, schema=schema)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_durably(directory / TABLE_FILE, sink.getvalue().to_pybytes())


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def read_table(directory: Path) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """The columns of a finished sweep by name, and its manifest. Raises UserError when there is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = directory / TABLE_FILE
    try:
        table = pq.read_table(path)
        return table.to_pydict(), json.loads(table.schema.metadata[_METADATA])
    except FileNotFoundError:
        raise UserError(f"{path}: there is none; a sweep writes it when it is finished") from None
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: not the table of a sweep ({error})") from None
