"""A recorded run, read back: what it was, how it ended, its signals; also of one that was killed on its way."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.analysis.verdict import judge
from hil.errors import UserError
from hil.record import journal
from hil.record.signals import Signals, load_tables
from hil.scenario import Scenario, from_record

CUT_OFF = "cut off"  # the verdict of a run that was killed: it has none


@dataclass(frozen=True)
class Recorded:
    """One run.

    verdict: stable, unstable, failed, or ``CUT_OFF``. metrics: as in run.json; of a run that was cut off, of what there
    is. injected: what was changed while it ran, as ``time_s``, ``key``, ``value``, and ``by``: scenario or query.
    frames: how many came in from outside. end: how far it went, s.
    """

    directory: Path
    scenario: Scenario
    seed: int
    verdict: str
    reason: str
    metrics: Mapping[str, Any]
    injected: tuple[Mapping[str, Any], ...]
    tables: Mapping[str, Signals]
    frames: int
    end: float
    record: Mapping[str, Any] | None  # the content of run.json

    @property
    def configuration(self) -> dict[str, Any]:
        """The scenario as run.json has it."""
        return self.scenario.model_dump(mode="json")


def read_run(directory: Path) -> Recorded:
    """The run recorded in ``directory``. Raises UserError for one that holds none."""
    if not (directory / journal.JOURNAL_FILE).exists():
        what = "is no directory" if not directory.is_dir() else f"holds no {journal.JOURNAL_FILE}"
        raise UserError(f"{directory}: not the record of a run: it {what}")
    head, *entries = journal.read(directory)
    seed, configuration = head["run"]["seed"], head["run"]["configuration"]
    scenario = from_record(configuration, f"{directory / journal.JOURNAL_FILE}: configuration")
    tables = load_tables(directory)
    missing = [name for name in ("world", "controller", "drives", "bus") if name not in tables]
    if missing:
        raise UserError(f"{directory}: its signals have no channel {missing[0]!r}")
    record = _record(directory)
    if record is not None:
        verdict, reason, metrics = record["verdict"], record["reason"], record["metrics"]
        injected, end = record["injected"], record["simulated_time"]
    else:
        verdict = CUT_OFF
        end = float(tables["world"].seconds[-1]) if len(tables["world"]) else 0.0
        reason = f"ended from outside at {end:.2f} s of {scenario.duration:g} s"
        metrics = judge(tables, scenario, stopped=None).metrics
        changes = (e for e in entries if "key" in e)
        injected = [
            {"time_s": e["time_ns"] * 1e-9, "key": e["key"], "value": e["value"], "by": e["by"]} for e in changes
        ]
    return Recorded(
        directory, scenario, seed, verdict, reason, metrics, tuple(injected), tables,
        sum("frame" in e for e in entries), end, record,
    )  # fmt: skip


def _record(directory: Path) -> dict[str, Any] | None:
    """The content of run.json; None when the run did not get to write it. Raises UserError for anything else."""
    path = directory / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        raise UserError(f"{path}: cannot be read as the record of a run") from None
    needed = ("verdict", "reason", "metrics", "injected", "simulated_time")
    if not isinstance(record, dict) or any(key not in record for key in needed):
        raise UserError(f"{path}: cannot be read as the record of a run")
    return record
