"""A run that is taken back goes on as it went."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.run import Request, assemble
from hil.scenario import load


def goes_on_as_it_went(scenario: str, settings: Sequence[str], at_ns: int, until_ns: int) -> None:
    """From a snapshot at ``at_ns`` to ``until_ns``, and once more: physics and controller are the same to the bit."""
    with assemble(Request(load(scenario, list(settings)), 0, "inline")) as assembly:
        system = assembly.system
        system.run_until(at_ns)
        before = system.snapshot()
        ends = []
        for _ in range(2):
            system.run_until(until_ns)
            ends.append((system.world.truth().copy(), system.controller.finish()[1].copy()))
            system.restore(before)
    assert np.array_equal(ends[0][0], ends[1][0]) and np.array_equal(ends[0][1], ends[1][1], equal_nan=True)
