"""A standing robot in another system: to the bit the same where nothing differs, and as unstable as its gains are."""

import pytest

from hil.errors import UserError
from hil.lab.experiment import outcome
from hil.lab.quantity import quantity
from hil.lab.transplant import Standing, run_standing_cell
from hil.scenario import load

AT = 0.9  # s
SCENARIO = load("stand", [
    "duration=1.3s", "limits.settle=0.9s", "world.hoist.hold=0.3s", "world.hoist.release=0.2s",
    "controller.stand_at=0.2s",
])  # fmt: skip
TASK = quantity(SCENARIO, "controller.task_bandwidth")


@pytest.fixture(scope="module")
def standing() -> Standing:
    return Standing(SCENARIO, 3, AT)


def test_with_the_same_gains_it_is_the_run_itself(standing: Standing) -> None:
    assert standing.outcome({TASK: 1.0}).digest == outcome(SCENARIO, 3).digest


def test_the_gains_change_while_it_stands(standing: Standing) -> None:
    calm, wild = (standing.outcome({TASK: value}) for value in (1.2, 30.0))
    assert calm.stable, calm.reason
    assert not wild.stable
    assert wild.simulated > AT


def test_a_cell_is_that_outcome(standing: Standing) -> None:
    cell, row = run_standing_cell(SCENARIO, AT, {TASK: 1.2}, (5, 3))
    assert cell == (5, 3)
    assert row["digest"] == standing.outcome({TASK: 1.2}).digest
    assert row["verdict"] == "stable"


def test_what_cannot_change_while_it_stands_is_refused(standing: Standing) -> None:
    with pytest.raises(UserError, match=r"firmware\.rate: a standing robot cannot be given another value"):
        standing.outcome({quantity(SCENARIO, "firmware.rate"): 6000.0})


def test_a_robot_that_does_not_come_that_far_is_told() -> None:
    stiff = TASK.applied(SCENARIO, 30.0)
    with pytest.raises(UserError, match=r"stand does not stand until 0\.9 s: "):
        Standing(stiff, 3, AT)
