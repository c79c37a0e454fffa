"""A run that goes on as far as it is told to: looked at, injected into, rewound and judged by its caller."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import Any

from hil.errors import UserError
from hil.injection import injectable
from hil.record.journal import JOURNAL_FILE, Entries
from hil.record.signals import SIGNALS_FILE, Signals
from hil.run import Outcome, Request, assemble, conclude, origin, write_record
from hil.scenario import Scenario, parse_value
from hil.schema import nearest
from robots import description
from robots.quantities import parse_quantity


class Running:
    """A system of the inline backend in virtual time, its record kept in memory.

    It ends where its scenario does, or earlier where it has failed: then ``stopped`` says why. Not to be used after
    ``close``, but for ``outcome`` and ``save``.

    Raises UserError when the robot cannot stand as the scenario asks.
    """

    def __init__(self, scenario: Scenario, seed: int = 0) -> None:
        self.scenario, self.seed = scenario, seed
        self._journal = Entries()
        self._request = Request(
            scenario, seed, "inline", report=False, journal=self._journal, signals=False
        )  # Ctrl-C is whoever's who holds this
        self._end_ns = round(scenario.duration * 1e9)
        self._known = injectable(description.load(scenario.robot))
        self._elapsed = 0.0
        self._outcome: Outcome | None = None
        self._life = contextlib.ExitStack()
        try:
            assembly = self._life.enter_context(assemble(self._request))
        except ValueError as error:
            from plant.stance import StanceError

            if not isinstance(error, StanceError):
                raise
            raise UserError(f"{scenario.name}: stance: {error}") from None
        self._system, self._recorder = assembly.system, assembly.recorder
        self._open = True
        self._journal.write({"run": origin(self._request)})

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        state = self.stopped or f"at {self.time:.3f} s"
        return f"<{self.scenario.name}, seed {self.seed}, {state}>"

    @property
    def time(self) -> float:
        """How far it is, s."""
        return self._system.now_ns * 1e-9

    @property
    def stopped(self) -> str | None:
        """Why it ended before its time, one sentence; None while it stands."""
        return self._system.stop_reason

    @property
    def signals(self) -> dict[str, Signals]:
        """All that was recorded so far, by channel: ``signals["world"]["com.z"]``."""
        return self._recorder.tables()

    def until(self, end: float | str) -> Running:
        """Go on to ``end`` (s, or a text as "250ms"), or to a failure. Returns this run.

        Raises UserError for a time that has passed, or that lies beyond the scenario's end.
        """
        try:
            seconds = parse_quantity(end, "s") if isinstance(end, str) else float(end)
        except ValueError as error:
            raise UserError(f"until: {error}") from None
        end_ns = round(seconds * 1e9)
        if not self._system.now_ns <= end_ns <= self._end_ns:
            span = f"{self.time:g} s, now, to {self.scenario.duration:g} s, where the scenario ends"
            raise UserError(f"until {seconds:g} s: expected {span}")
        self._advance(end_ns)
        return self

    def _advance(self, end_ns: int) -> None:
        began = time.monotonic()
        self._system.run_until(end_ns)
        self._elapsed += time.monotonic() - began
        self._outcome = None

    def inject(self, key: str, value: Any) -> float | bool | str:
        """Change one value from the controller's next tick on, as ``hil inject`` does. Returns it in SI units.

        Raises UserError for an unknown key or a value that it does not take.
        """
        if key not in self._known:
            raise UserError(f"nothing to inject at {key!r}{nearest(key, list(self._known))}")
        parsed = parse_value(key, value)
        self._system.requests.append(lambda: self._system.inject(key, value))
        return parsed

    def snapshot(self) -> dict[str, Any]:
        """Everything, to come back to with ``restore`` as often as wanted."""
        system = self._system.snapshot()  # first: it awaits an answer that is under way
        return {
            "system": system,
            "requests": list(self._system.requests),
            "recorder": self._recorder.snapshot(),
            "journal": list(self._journal.entries),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a snapshot of this run: it goes on from there as the first time, unless something is changed."""
        self._system.restore(state["system"])
        self._system.requests.clear()
        self._system.requests.extend(state["requests"])
        self._recorder.restore(state["recorder"])
        self._journal.entries = list(state["journal"])
        self._outcome = None

    def outcome(self) -> Outcome:
        """Judge what has been so far."""
        if self._outcome is None:
            self._outcome = conclude(self._request, self._system, self._recorder, None, self._elapsed)
        return self._outcome

    def finish(self) -> Outcome:
        """Go on to the end of the scenario, or to a failure, and judge."""
        self._advance(self._end_ns)
        self._journal.write({"end_ns": self._system.now_ns, "digest": self._recorder.digest()})
        outcome = self.outcome()
        self.close()
        return outcome

    def close(self) -> None:
        """Free what the system holds; a second call does nothing."""
        if self._open:
            self.outcome()
            self._open = False
            self._life.close()

    def save(self, directory: Path) -> None:
        """Write the record as of now into ``directory``, which is created: verdict, report, signals, and the journal, so
        that ``hil replay`` can repeat it. The buses' logs are not kept in memory: ``hil replay --out`` writes them."""
        from hil.record.mcap_writer import McapWriter

        outcome = self.outcome()
        directory.mkdir(parents=True, exist_ok=True)
        writer = McapWriter(directory / SIGNALS_FILE, {name: table.names for name, table in outcome.tables.items()})
        for name, table in outcome.tables.items():
            writer.write(name, table.times, table.data)
        writer.close()
        lines = "".join(json.dumps(entry) + "\n" for entry in self._journal.entries)
        (directory / JOURNAL_FILE).write_text(lines, encoding="utf-8")
        write_record(directory, self.scenario, outcome)
