"""The ring of the last physics steps."""

from pathlib import Path

import numpy as np
import pytest

from hil.record.ring import LAST_SECONDS_FILE, StepRing
from hil.record.signals import Signals
from hil.run import Request, run
from hil.scenario import load


def filled(steps: int, capacity: int = 4) -> Signals:
    a, b = np.zeros(2), np.zeros(1)
    ring = StepRing([(["x", "y"], a), (["z"], b)], rate=1000.0, seconds=capacity / 1000.0)
    for step in range(1, steps + 1):
        a[:], b[:] = (step, -step), 10 * step
        ring.append()
    return ring.table(steps)


@pytest.mark.parametrize("steps", [0, 1, 3, 4, 5, 8, 11])
def test_holds_the_last_rows_in_time(steps: int) -> None:
    table = filled(steps)
    kept = np.arange(max(1, steps - 3), steps + 1)
    assert table.names == ("x", "y", "z")
    np.testing.assert_array_equal(table.data, np.stack([kept, -kept, 10 * kept], axis=1).reshape(-1, 3))
    np.testing.assert_array_equal(table.times, kept * 1_000_000)


def test_what_was_set_back_is_forgotten() -> None:
    x = np.zeros(1)
    ring = StepRing([(["x"], x)], rate=10.0, seconds=0.3)
    for value in (1.0, 2.0, 3.0, 4.0):
        x[0] = value
        ring.append()
    ring.clear()
    assert not len(ring.table(4))
    x[0] = 9.0
    ring.append()
    table = ring.table(2)
    assert table["x"].tolist() == [9.0] and table.times.tolist() == [200_000_000]


def test_a_run_that_fails_leaves_every_physics_step_of_its_last_seconds(tmp_path: Path) -> None:
    """At twice the firmware's rate; its rows are those of the record where that has one."""
    settings = {"duration": "0.3s", "world.rate": "6kHz", "bus.left_leg.node.left_knee.cut": True,
                "limits.drive_silent": "10ms", "controller.stand_at": "0.05s", "limits.fall_height": 1.2}  # fmt: skip
    outcome = run(Request(load("stand", settings), 0, "inline", out=tmp_path / "run", report=False))
    assert not outcome.stable
    table = Signals.load(tmp_path / "run", "physics", LAST_SECONDS_FILE)
    assert np.all(np.abs(np.diff(table.times) - 1e9 / 6000) <= 1)
    world = outcome.tables["world"]
    at = np.flatnonzero(np.isin(world.times, table.times))
    assert len(at) > 10
    rows = np.searchsorted(table.times, world.times[at])
    for name in ("com.z", "qpos.3", "contact.left_foot.z"):
        np.testing.assert_array_equal(table[name][rows], world[name][at])
    # until the run ended: the last step reaches up to the next interrupt
    assert 0 <= table.times[-1] * 1e-9 - outcome.record["simulated_time"] < 1 / 3000


def test_a_run_that_stands_leaves_none(tmp_path: Path) -> None:
    run(Request(load("stand", {"duration": "20ms"}), 0, "inline", out=tmp_path / "run", report=False))
    assert not (tmp_path / "run" / LAST_SECONDS_FILE).exists()
