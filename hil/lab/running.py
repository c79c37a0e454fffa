"""A run that goes on as far as it is told to: looked at, injected into, rewound, judged and saved by its caller."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from hil.errors import UserError
from hil.lab.experiment import Experiment
from hil.record.journal import JOURNAL_FILE, Entries
from hil.record.signals import SIGNALS_FILE, Signals
from hil.report.html import Link
from hil.run import Outcome, conclude, origin, write_record
from hil.scenario import Scenario
from robots.quantities import parse_quantity


class Running:
    """An experiment (``hil.lab.experiment``) with a journal, so that it can be kept as a record like that of any run.

    It ends where its scenario does, or earlier where it has failed: then ``stopped`` says why. Use as a context
    manager, or ``close`` it.

    Raises UserError when the robot cannot stand as the scenario asks.
    """

    def __init__(self, scenario: Scenario, seed: int = 0) -> None:
        self.scenario, self.seed = scenario, seed
        self._journal = Entries()
        self._experiment = Experiment(scenario, seed, self._journal)
        self.system = self._experiment.system
        self._journal.write({"run": origin(self._experiment.request)})
        self._end_ns = round(scenario.duration * 1e9)
        self._elapsed = 0.0  # wall-clock time, s
        self._outcome: Outcome | None = None

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{self.scenario.name}, seed {self.seed}, {self.stopped or f'at {self.time:.3f} s'}>"

    @property
    def time(self) -> float:
        """How far it is, s."""
        return self._experiment.now

    @property
    def stopped(self) -> str | None:
        """Why it ended before its time, one sentence; None while it stands."""
        return self._experiment.failed

    @property
    def signals(self) -> dict[str, Signals]:
        """All that was recorded so far, by channel: ``signals["world"]["com.z"]``."""
        return self._experiment.tables()

    def until(self, end: float | str) -> Running:
        """Go on to ``end`` (s, or a text as "250ms"), or to a failure. Returns this run.

        Raises UserError for a time that has passed, or that lies beyond the scenario's end.
        """
        try:
            seconds = parse_quantity(end, "s") if isinstance(end, str) else float(end)
            end_ns = round(seconds * 1e9)
        except ValueError as error:
            raise UserError(f"until: {error}") from None
        if not self.system.now_ns <= end_ns <= self._end_ns:
            span = f"{self.time:g} s, now, to {self.scenario.duration:g} s, where the scenario ends"
            raise UserError(f"until {seconds:g} s: expected {span}")
        self._advance(seconds)
        return self

    def _advance(self, seconds: float) -> None:
        self._outcome = None
        began = time.monotonic()
        self._experiment.until(seconds)
        self._elapsed += time.monotonic() - began

    def inject(self, key: str, value: Any) -> None:
        """Change one value from the controller's next tick on, as ``hil inject`` does.

        Raises UserError for an unknown key or a value that it does not take.
        """
        try:
            self._experiment.inject(key, value)
        except UserError as error:
            raise UserError(str(error)) from None  # without the way that led to it

    def snapshot(self) -> dict[str, Any]:
        """Everything, to come back to with ``restore`` as often as wanted."""
        state = self._experiment.snapshot()
        return {"experiment": state, "requests": list(self.system.requests), "journal": list(self._journal.entries)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a snapshot of this run: it goes on from there as the first time, unless something is changed."""
        self._outcome = None
        self._experiment.restore(state["experiment"])
        self.system.requests.extend(state["requests"])
        self._journal.entries = list(state["journal"])

    def outcome(self) -> Outcome:
        """Judge what has been so far."""
        if self._outcome is None:
            experiment = self._experiment
            self._outcome = conclude(experiment.request, self.system, experiment.recorder, None, self._elapsed)
        return self._outcome

    def finish(self) -> Outcome:
        """Go on to the end of the scenario, or to a failure, and judge."""
        self._advance(self.scenario.duration)
        outcome = self.outcome()
        self._journal.write({"end_ns": self.system.now_ns, "digest": outcome.digest})
        self.close()
        return outcome

    def close(self) -> None:
        """Free what only a run that goes on needs; a second call does nothing."""
        self._experiment.close()

    def save(self, directory: Path, video: bool = False, part_of: Link | None = None) -> None:
        """Write the record as of now into ``directory``, which is created: verdict, report, signals, and the journal,
        so that ``hil replay`` can repeat it. Buses' logs are not kept in memory: ``hil replay --out`` writes them.

        video: its video, too; raises EmulationError without off-screen OpenGL. part_of: the page that it belongs to.
        """
        from hil.record.mcap_writer import McapWriter

        outcome = self.outcome()
        directory.mkdir(parents=True, exist_ok=True)
        writer = McapWriter(directory / SIGNALS_FILE, {name: table.names for name, table in outcome.tables.items()})
        for name, table in outcome.tables.items():
            writer.write(name, table.times, table.data)
        writer.close()
        lines = "".join(json.dumps(entry) + "\n" for entry in self._journal.entries)
        (directory / JOURNAL_FILE).write_text(lines, encoding="utf-8")
        if video and len(outcome.tables):
            from hil.report.video import write_video

            write_video(directory, self.scenario, outcome.tables)
        write_record(directory, self.scenario, outcome, part_of=part_of)
