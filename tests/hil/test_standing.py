"""The whole loop stands up and stays, in the conditions that once felled it; each run is a few seconds inline."""

from __future__ import annotations

import pytest

from hil.run import Request, run
from hil.scenario import load

CASES = {
    "split-terrain": [],
    "split-terrain, 20 degrees": ["terrain.panel_angle=20deg"],
    "split-terrain, feed-forward only": ["controller.internal_force.feedback=false"],
    "split-terrain, no friction to hold the joints": ["world.friction_scale=0"],
    "split-terrain, other masses than the controller's": ["world.variant=srlib"],
    "split-terrain, 4 ms late": ["link.command.delay=4ms"],
    "stand": [],
    "stand, no friction to hold the joints": ["world.friction_scale=0"],
}


@pytest.mark.parametrize("case", CASES)
def test_stands(case: str) -> None:
    scenario = load(case.split(",")[0], ["duration=4s", *CASES[case]])
    outcome = run(Request(scenario, seed=3, backend="inline", report=False))
    metrics = outcome.record["metrics"]
    assert outcome.stable, outcome.record["reason"]
    assert metrics["com_error_max"] < 0.02
    assert metrics["foot_slip_max"] < 0.003


def test_feedback_of_the_internal_force_takes_out_what_friction_puts_in() -> None:
    """Kim 2018 §5.1.2: the same gains with and without (5.2)."""
    errors = {}
    for feedback in ("true", "false"):
        settings = ["duration=6s", f"controller.internal_force.feedback={feedback}"]
        outcome = run(Request(load("split-terrain", settings), seed=1, backend="inline", report=False))
        errors[feedback] = outcome.record["metrics"]["internal_force_error"]
        assert outcome.record["metrics"]["internal_force_sensed_vs_truth"] < 0.05
    assert errors["true"] < 0.2
    assert errors["false"] > 2.5 * errors["true"]


def test_pushed_it_shows_the_stiffness_that_was_commanded() -> None:
    """Kim 2018 Fig. 5.3c: mass times kp of each direction."""
    scenario = load("split-terrain-push")
    outcome = run(Request(scenario, seed=1, backend="inline", report=False))
    assert outcome.stable, outcome.record["reason"]
    from robots import description

    mass, tasks = description.load("hume").mass, scenario.controller.tasks
    assert outcome.record["metrics"]["stiffness_x"] == pytest.approx(mass * tasks.com_x.kp, rel=0.25)
    assert outcome.record["metrics"]["stiffness_z"] == pytest.approx(mass * tasks.com_z.kp, rel=0.25)
