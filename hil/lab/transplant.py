"""A standing robot put into another system: the same in all that moves and remembers, with other gains."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

from hil.errors import UserError
from hil.lab.cell_journal import Cell
from hil.lab.experiment import Experiment, Outcome
from hil.lab.quantity import Quantity, Value, changed
from hil.lab.sweep import Row, row_of
from hil.scenario import Scenario

# Keys of what a standing robot can be given, and among them those that it must have had while it stood up.
_MOVABLE = ("controller.", "firmware.", "joint.")
_NOT_MOVABLE = (
    "controller.rate", "controller.variant", "firmware.rate", "firmware.report_rate", "firmware.law",
    "firmware.velocity_estimator",
)  # fmt: skip


def movable(quantity: Quantity) -> bool:
    """Whether a standing robot can be given another value of it."""
    return quantity.key.startswith(_MOVABLE) and not quantity.key.startswith(_NOT_MOVABLE)


def moved(settled: dict[str, Any], fresh: dict[str, Any]) -> dict[str, Any]:
    """Snapshot ``settled`` with what is configuration in it replaced by that of ``fresh``, of another system."""
    world = settled["world"]
    return {
        **settled,
        "world": {**world, "actuators": (*world["actuators"][:-1], fresh["world"]["actuators"][-1])},  # parameters
        "joints": [
            {**old, "settings": (new["settings"][0], *old["settings"][1:])}  # what it has measured of itself stays
            for old, new in zip(settled["joints"], fresh["joints"], strict=True)
        ],
        "links": {
            path: {**old, "impairment": fresh["links"][path]["impairment"]} for path, old in settled["links"].items()
        },
        "wires": [
            {**old, "impairment": new["impairment"]} for old, new in zip(settled["wires"], fresh["wires"], strict=True)
        ],
        "injector": fresh["injector"],
    }


class Standing:
    """``scenario`` run until ``at`` s, to go on in other systems. Raises UserError when it does not come that far."""

    def __init__(self, scenario: Scenario, seed: int, at: float) -> None:
        self.scenario, self.seed = scenario, seed
        with Experiment(scenario, seed) as experiment:
            experiment.until(at)
            if experiment.failed is not None:
                raise UserError(f"{scenario.name} does not stand until {at:g} s: {experiment.failed}")
            self._settled = experiment.snapshot()

    def outcome(self, values: Mapping[Quantity, Value]) -> Outcome:
        """Go on to the scenario's end with ``values`` (SI), each of a quantity that is ``movable``."""
        held = [q.key for q in values if not movable(q)]
        if held:
            raise UserError(f"{', '.join(held)}: a standing robot cannot be given another value")
        scenario = changed(self.scenario, {q.key: q.written(value) for q, value in values.items()})
        with Experiment(scenario, self.seed) as experiment:
            system = moved(self._settled["system"], experiment.snapshot()["system"])
            experiment.restore({**self._settled, "system": system})
            experiment.until(scenario.duration)
            return experiment.outcome()


_kept = threading.local()  # a worker's standing robot waits for its next cell


def run_standing_cell(scenario: Scenario, at: float, values: dict[Quantity, Value], cell: Cell) -> tuple[Cell, Row]:
    """As ``hil.lab.sweep.run_cell``, but what cannot be injected changes at ``at`` s: the robot stood up without."""
    key, began, simulated = (scenario, at, cell[1]), time.thread_time(), 0.0
    if getattr(_kept, "key", None) != key:
        _kept.key, _kept.standing, simulated = None, Standing(scenario, cell[1], at), at
        _kept.key = key
    found = _kept.standing.outcome(values)
    return cell, {
        **row_of(found),
        "simulated_here": simulated + found.simulated - at,
        "cpu": time.thread_time() - began,
    }
