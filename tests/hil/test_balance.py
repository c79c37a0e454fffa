"""Hume steps, unsupported, through its joints, buses and link."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from central_controller.behaviours.step import State, diagram
from hil.analysis.steps import touch_downs
from hil.run import Request, run
from hil.scenario import load
from tests.support.snapshots import goes_on_as_it_went

ROOT = Path(__file__).parent.parent.parent


def stepped(*settings: str, backend: str = "inline") -> Any:
    return run(Request(load("balance", list(settings)), 0, backend, report=False))


@pytest.fixture(scope="module")
def outcome() -> Any:
    return stepped("duration=3.7s")


def test_the_robot_steps_from_foot_to_foot(outcome: Any) -> None:
    assert outcome.stable, outcome.reason
    metrics = outcome.metrics
    assert metrics["steps"] >= 4
    assert 0.335 < metrics["step_time_mean"] < 0.5  # Table 7.2, and the longest extension with a late foot
    assert metrics["orientation_error_max"] < 0.1
    assert metrics["foot_placement_error_rms"] < 0.03


def test_it_makes_more_steps_than_the_source_reports() -> None:
    """Kim 2018 §7.3.3: 18, unsupported."""
    longer = stepped("duration=10s")
    assert longer.stable, longer.reason
    assert longer.metrics["steps"] >= 18


def test_a_foot_that_is_said_to_swing_is_in_the_air_and_one_that_stands_carries(outcome: Any) -> None:
    """By the physics' own contact forces."""
    controller, world = outcome.tables["controller"], outcome.tables["world"]
    rows = world.latest_before(controller.times)
    late_lift = (controller["state"] == State.LIFTING) & (np.roll(controller["state"], 60) == State.LIFTING)
    for foot, other in (("right_foot", "left_foot"), ("left_foot", "right_foot")):
        swings = late_lift & (controller[f"carries.{foot}"] == 0)
        assert swings.sum() > 100
        assert np.abs(world[f"contact.{foot}.z"][rows][swings]).max() == 0.0
        assert np.abs(world[f"contact.{other}.z"][rows][swings]).min() > 50.0
    assert len(touch_downs(controller)) >= 4


def test_the_swing_foot_is_on_its_way_while_it_rises(outcome: Any) -> None:
    """As swing.depart has it, without a jump when the plan changes."""
    controller = outcome.tables["controller"]
    reference = np.stack([controller[f"swing_reference.{axis}"] for axis in "xy"], axis=1)
    plan = np.stack([controller[f"plan.foot.{axis}"] for axis in "xy"], axis=1)
    lifting = controller["state"] == State.LIFTING
    starts = np.flatnonzero(np.diff(lifting.astype(int)) == 1) + 1
    ends = np.flatnonzero(np.diff(lifting.astype(int)) == -1)
    gone = [np.linalg.norm(reference[b] - reference[a]) / np.linalg.norm(plan[b] - reference[a])
            for a, b in zip(starts, ends, strict=False)]  # fmt: skip
    assert len(gone) >= 4
    assert min(gone) > 0.1 and max(gone) < 0.7  # of the way: 0.31 to 0.48 for a cubic that is never planned anew
    swinging = lifting & np.roll(lifting, 1)
    assert np.abs(np.diff(reference, axis=0, prepend=reference[:1])[swinging]).max() < 0.004  # m per tick


def test_the_planner_reads_the_velocity_of_the_centre_of_mass(outcome: Any) -> None:
    controller, world = outcome.tables["controller"], outcome.tables["world"]
    falling = controller["state"] == State.LIFTING
    rows = world.latest_before(controller.times)
    for axis in "xy":
        error = controller[f"pendulum.v{axis}"] - world[f"com_velocity.{axis}"][rows]
        assert np.sqrt(np.mean(error[falling] ** 2)) < 0.08


def test_the_transition_takes_the_jump_out_of_the_torques_at_a_switch(outcome: Any) -> None:
    """Kim 2018 §2.2.1."""
    without = stepped("duration=2.1s", "controller.stepping.transition=false")
    for switch in ("torque_step_at_lift_max", "torque_step_at_touchdown_max"):
        assert outcome.metrics[switch] is not None
    assert outcome.metrics["torque_step_at_lift_max"] < 20.0 < 30.0 < without.metrics["torque_step_at_lift_max"]


def test_it_walks_after_a_goal_that_moves() -> None:
    settings = ("controller.stepping.goal_velocity_x=0.2m/s", "controller.stepping.planner.goal_distance=1m")
    walked = stepped("duration=7s", *settings)
    assert walked.stable, walked.reason
    assert walked.tables["world"]["com.x"][-1] == pytest.approx(0.2 * (7.0 - 1.2), rel=0.25)  # from the first step on


def test_a_drifting_gyro_needs_the_cameras() -> None:
    """Kim 2018 §7.3.3, App. E: without them the robot walks off after the tilt that it believes."""
    without = stepped(
        "duration=7s", "motion_capture.enabled=false", "controller.orientation=complementary",
        "controller.orientation_time_constant=10s",
    )  # fmt: skip
    with_cameras = stepped("duration=7s")
    gone = [float(np.hypot(run.tables["world"]["com.x"][-1], run.tables["world"]["com.y"][-1]))
            for run in (without, with_cameras)]  # fmt: skip
    assert gone[1] < 0.1 and gone[0] > 2 * gone[1]


def test_both_backends_step_alike() -> None:
    runs = [stepped("duration=1.7s", backend=backend) for backend in ("inline", "processes")]
    assert runs[0].digest == runs[1].digest
    assert runs[0].tables["controller"]["state"].max() >= State.LIFTING


def test_a_step_goes_on_from_a_snapshot_as_it_went() -> None:
    goes_on_as_it_went("balance", ["duration=3s"], 1_700_000_000, 2_000_000_000)  # a foot is in the air


def test_the_documents_show_the_machine_as_it_is() -> None:
    assert diagram() in (ROOT / "docs" / "walking.md").read_text(encoding="utf-8")


def test_the_reference_of_metrics_is_complete(outcome: Any) -> None:
    rows = re.findall(r"^\| (`.*?) \|.*$", (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8"), re.MULTILINE)
    told = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert told == {name for name in outcome.metrics if not name.endswith("_samples")}
