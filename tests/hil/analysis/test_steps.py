"""Steps and their numbers, of a record that is known."""

import numpy as np
import pytest

from central_controller.behaviours.step import State
from hil.analysis.derived import Derived
from hil.analysis.stepping import LIFT, TOUCHDOWN, stepping_metrics, torque_changes, torque_step
from hil.analysis.steps import PHASES, steps_of, touch_downs
from hil.record.signals import Signals
from plant.config import TerrainConfig
from tests.support.stepping import DURATIONS, FIRST, PLAN, STEP, stepping_run

ERRORS = [(0.01, 0.0), (0.0, -0.02), (-0.01, 0.01), (0.0, 0.0), (0.02, 0.01)]
EMPTY = Signals(np.zeros(0, np.int64), (), np.zeros((0, 0)))


def metrics(tables: dict[str, Signals]) -> dict:
    return stepping_metrics(Derived({**tables, "drives": EMPTY, "bus": EMPTY}, TerrainConfig(), settle=0.1))


def test_the_steps_are_found_with_their_feet_times_and_places() -> None:
    tables = stepping_run(ERRORS)
    steps = steps_of(tables["controller"], tables["world"])
    assert [step.number for step in steps] == [1, 2, 3, 4, 5]
    assert [step.swing for step in steps] == ["right_foot", "left_foot", "right_foot", "left_foot", "right_foot"]
    for n, (step, error) in enumerate(zip(steps, ERRORS, strict=True)):
        assert step.began[State.UNLOADING] == FIRST + n * STEP
        assert step.planned_at == FIRST + n * STEP + PLAN
        assert step.planned == pytest.approx([0.02, -0.2 if n % 2 == 0 else 0.2])
        assert step.error == pytest.approx(error)
        durations = step.durations(tables["controller"].seconds)
        known = PHASES if n < 4 else PHASES[:-1]  # nothing ends the last state of the last step
        assert durations == pytest.approx({state: DURATIONS[state] / 1000 for state in known})


def test_a_foot_that_never_landed_is_no_step() -> None:
    tables = stepping_run(ERRORS[:2])
    cut = {name: Signals(t.times[:500], t.names, t.data[:500]) for name, t in tables.items()}
    assert [step.number for step in steps_of(cut["controller"], cut["world"])] == [1]


def test_a_step_without_a_plan_has_no_error() -> None:
    tables = stepping_run(ERRORS[:1])
    controller = tables["controller"]
    for name in controller.members("plan"):
        controller[f"plan.{name}"][:] = 0.0
    (step,) = steps_of(controller, tables["world"])
    assert step.planned_at is None and np.isnan(step.error).all()
    assert metrics(tables)["foot_placement_error_rms"] is None


def test_the_metrics_are_those_of_the_steps() -> None:
    tables = stepping_run(ERRORS)
    found = metrics(tables)
    assert found["steps"] == 5
    assert found["step_time_mean"] == pytest.approx(STEP / 1000)
    assert found["foot_placement_error_rms"] == pytest.approx(np.sqrt(np.mean(np.square(ERRORS).sum(axis=1))))
    assert found["foot_placement_error_max"] == pytest.approx(np.hypot(0.02, 0.01))


def test_the_steady_orientation_leaves_out_the_start_and_the_fall() -> None:
    tables = stepping_run(ERRORS)
    touches = touch_downs(tables["controller"])
    roll = tables["world"]["base.roll"]
    roll[: touches[2] - 1], roll[touches[-1] + 1 :] = 0.5, -1.0
    roll[touches[3]] = -0.04
    tables["world"]["base.pitch"][touches[3] + 5] = 0.03
    assert metrics(tables)["orientation_error_max_steady"] == pytest.approx(0.04)
    tables["controller"]["roll_reference"][touches[3]] = -0.04  # the error is to the reference
    assert metrics(tables)["orientation_error_max_steady"] == pytest.approx(0.03)
    assert metrics(stepping_run(ERRORS[:3]))["orientation_error_max_steady"] is None


@pytest.mark.parametrize(
    ("after", "lift", "touchdown"),
    [
        (0, 30.0, 0.0), (20, 30.0, 0.0),  # single support begins; the foot lifts
        (270, 0.0, 30.0), (300, 0.0, 30.0), (302, 0.0, 30.0),  # it lands; double support begins
        (19, 0.0, 0.0), (303, 0.0, 0.0), (150, 0.0, 0.0), (299, 0.0, 0.0),  # no switch
    ],
)  # fmt: skip
def test_a_torque_step_counts_at_the_switch_that_it_comes_with(after: int, lift: float, touchdown: float) -> None:
    tables = stepping_run(ERRORS)
    controller, row = tables["controller"], FIRST + STEP + after
    controller["torque_command.left_knee"][row:] = -30.0
    found = metrics(tables)
    assert (found["torque_step_at_lift_max"], found["torque_step_at_touchdown_max"]) == (lift, touchdown)
    steps, changes = steps_of(controller, tables["world"]), torque_changes(controller)
    assert [torque_step(controller, changes, step, LIFT) for step in steps] == [0.0, lift, 0.0, 0.0, 0.0]
    assert [torque_step(controller, changes, step, TOUCHDOWN) for step in steps] == [0.0, touchdown, 0.0, 0.0, 0.0]


def test_a_run_of_another_kind_and_one_full_of_gaps_have_none() -> None:
    tables = stepping_run(ERRORS)
    controller = tables["controller"]
    gaps = Signals(controller.times, controller.names, np.full_like(controller.data, np.nan))
    assert steps_of(gaps, tables["world"]) == []
    found = metrics({**tables, "controller": gaps})
    assert found["steps"] == 0 and {found[key] for key in found if key != "steps"} == {None}
    standing = Signals(controller.times, ("state",), controller.data[:, :1])
    assert (
        steps_of(standing, tables["world"]) == []
        and stepping_metrics(
            Derived({**tables, "controller": standing, "drives": EMPTY, "bus": EMPTY}, TerrainConfig(), 0.1)
        )
        == {}
    )
