"""Experiments: a scenario and a seed, run inline and without files, to an outcome.

``Experiment`` goes step by step. ``Branch`` settles a system once and continues it many times, each time with other
values: every continuation is, to the bit, the run in which the scenario injects these values at that time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

from hil.errors import UserError
from hil.lab.quantity import Quantity, Value, changed, quantity
from hil.record.journal import Journal
from hil.run import Request, assemble
from hil.scenario import Scenario

_CHANNELS = ("world", "controller", "drives", "bus")


@dataclass(frozen=True)
class Outcome:
    """What came out. simulated: up to when it ran, s; a run that has failed is ended. came_first: of one that is not
    stable the first sign, kind and place (``hil.analysis.causes``); empty if there is none."""

    stable: bool
    reason: str
    metrics: dict[str, Any]
    digest: str
    simulated: float
    came_first: str = ""


class Experiment:
    """One system on the inline backend. Use as a context manager, or ``close`` it.

    ``journal`` takes the run's journal, if it is wanted. Raises UserError when the robot cannot stand like that.
    """

    def __init__(self, scenario: Scenario, seed: int, journal: Journal | None = None) -> None:
        from plant.stance import StanceError

        self.scenario, self.seed = scenario, seed
        self._stack = contextlib.ExitStack()
        self.request = Request(scenario, seed, backend="inline", signals=False, journal=journal)
        try:
            self._assembly = self._stack.enter_context(assemble(self.request))
        except StanceError as error:
            raise UserError(f"{scenario.name}: stance: {error}") from None
        self.system, self.recorder = self._assembly.system, self._assembly.recorder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._stack.close()

    @property
    def now(self) -> float:
        """Simulated time, s."""
        return self.system.now_ns * 1e-9

    @property
    def failed(self) -> str | None:
        """Why the run has ended before its time, None while it goes on."""
        return self.system.stop_reason

    def until(self, time: float) -> None:
        """Run all events before ``time``, s; less when the run has failed before."""
        self.system.run_until(round(time * 1e9))

    def inject(self, key: str, value: Value) -> None:
        """Change an injectable ``key`` to ``value`` (as written, with its unit) at the controller's next tick, as a
        scenario's injection for now does. Raises UserError, at once, for a wrong key or value."""
        from hil.scenario import parse_value

        if not quantity(self.scenario, key).injectable:
            raise UserError(f"{key} cannot be changed while a run goes on (`hil inject --list` shows what can)")
        parse_value(key, value)
        self.system.requests.append(partial(self.system.inject, key, value))

    def tables(self) -> dict[str, Any]:
        """The signals so far, by channel (``hil.record.signals.Signals``)."""
        return {name: self.recorder.table(name) for name in _CHANNELS}

    def outcome(self) -> Outcome:
        """Verdict, metrics and digest of what has run so far."""
        from hil.analysis.causes import signs
        from hil.analysis.verdict import judge

        tables = self.tables()
        verdict = judge(tables, self.scenario, stopped=self.failed)
        first = next(iter(signs(tables, self.scenario)), None) if not verdict.stable else None
        told = "" if first is None else f"{first.kind}, {first.where}"
        return Outcome(verdict.stable, verdict.reason, verdict.metrics, self.recorder.digest(), self.now, told)

    def snapshot(self) -> dict[str, Any]:
        """Everything at this moment, with the record so far; for this experiment only."""
        return {
            "system": self.system.snapshot(),
            "recorder": self.recorder.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to ``snapshot``."""
        self.system.restore(state["system"])
        self.system.requests.clear()
        self.recorder.restore(state["recorder"])


class Branch:
    """A system that has settled until ``at`` s, to be continued with other values again and again."""

    def __init__(self, scenario: Scenario, seed: int, at: float) -> None:
        if not at < scenario.duration:
            raise UserError(f"nothing happens after {at:g} s: the scenario ends at {scenario.duration:g} s")
        self.at = at
        self._experiment = Experiment(scenario, seed)
        self._experiment.until(at)
        self._settled = self._experiment.snapshot()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._experiment.close()

    @property
    def failed(self) -> str | None:
        """Why it failed before anything was injected, None if it has settled."""
        return self._settled["system"]["stop_reason"]

    @property
    def settled(self) -> float:
        """How far it has been simulated to settle, s: ``at``, or less when it failed before."""
        return self._settled["system"]["now_ns"] * 1e-9

    def outcome(self, values: Mapping[str, Value]) -> Outcome:
        """Continue to the scenario's end with ``values`` (as written) injected. Raises UserError for wrong ones."""
        experiment = self._experiment
        experiment.restore(self._settled)
        for key, value in values.items():
            experiment.inject(key, value)
        experiment.until(experiment.scenario.duration)
        return experiment.outcome()


def outcome(scenario: Scenario, seed: int) -> Outcome:
    """Run ``scenario`` from its start to its end."""
    with Experiment(scenario, seed) as experiment:
        experiment.until(scenario.duration)
        return experiment.outcome()


class Trials:
    """Outcomes of ``scenario`` with other values of its quantities: those that are injectable are injected at ``at`` s,
    the others hold from the start. The last settled system is kept, for the next trial that differs by injected values
    only. Use as a context manager, or ``close`` it.

    simulated: time simulated so far, s; less than what the trials cover, by the settled parts that they share.
    """

    def __init__(self, scenario: Scenario, at: float) -> None:
        self.scenario, self.at = scenario, at
        self.simulated = 0.0
        self._settled: tuple[Any, Branch] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._settled is not None:
            self._settled[1].close()
            self._settled = None

    def outcome(self, quantities: Mapping[Quantity, Value], seed: int) -> Outcome:
        """One trial. ``quantities``: values in SI units. Raises UserError for one that the scenario does not take."""
        injected = {q.key: q.written(value) for q, value in quantities.items() if q.injectable}
        fixed = {q.key: q.written(value) for q, value in quantities.items() if not q.injectable}
        if not injected:
            found = outcome(changed(self.scenario, fixed), seed)
            self.simulated += found.simulated
            return found
        name = seed, fixed
        if self._settled is None or self._settled[0] != name:
            self.close()
            scenario = changed(self.scenario, fixed) if fixed else self.scenario
            self._settled = name, Branch(scenario, seed, self.at)
            self.simulated += self._settled[1].settled
        branch = self._settled[1]
        found = branch.outcome(injected)
        self.simulated += found.simulated - branch.settled
        return found
