"""Sweeps of split terrain whose runs are made up: what is stable is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hil.lab.axes import axis
from hil.lab.sweep import Plan, sweep
from hil.scenario import load

SPLIT = load("split-terrain")


def swept(
    out: Path, axes: list[str], stable: Callable[..., bool], seeds: int = 8, sample: str | None = None,
    metrics: Callable[..., dict[str, Any]] = lambda *_: {}, scenario: Any = SPLIT,
    at: float = 2.5,
) -> Path:  # fmt: skip
    """A sweep whose runs are made up: ``stable(seed, *values)``, ``metrics(seed, *values)``."""

    def runner(_: object, calls: list) -> Iterator:
        for _scenario, _at, values, cell in calls:
            found = stable(cell[1], *values.values())
            yield cell, {
                "verdict": "stable" if found else "unstable", "reason": "stood" if found else "<slipped>",
                "simulated": 1.0, "metrics": metrics(cell[1], *values.values()), "digest": "", "simulated_here": 1.0,
                "cpu": 1.0,
            }  # fmt: skip

    parsed = tuple(axis(scenario, text, sample is not None) for text in axes)
    sweep(Plan(scenario, parsed, seeds, at, sample), out, runner)
    return out
