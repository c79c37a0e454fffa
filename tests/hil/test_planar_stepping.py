"""Hume steps in its planarizer, through its joints, buses and link: on the spot, to stay upright, towards a goal."""

from typing import Any

import numpy as np
import pytest

from central_controller.behaviours.step import State
from hil.analysis.stepping import touch_downs
from hil.record.signals import Signals
from hil.run import Request, run
from hil.scenario import load
from tests.support.snapshots import goes_on_as_it_went


def stepped(name: str, *settings: str, backend: str = "inline") -> Any:
    return run(Request(load(name, list(settings)), 0, backend, report=False))


@pytest.fixture(scope="module")
def on_the_spot() -> Any:
    return stepped("step-in-place", "duration=3.4s")


@pytest.fixture(scope="module")
def forward() -> Any:
    return stepped("walk-forward", "duration=4.6s")


def falling_rows(outcome: Any) -> tuple[Signals, Signals, np.ndarray, np.ndarray]:
    """Tables, the controller's rows while a foot swings, and the world's at the same times."""
    controller, world = outcome.tables["controller"], outcome.tables["world"]
    swinging = np.flatnonzero(controller["state"] == State.LANDING)
    return controller, world, swinging, world.latest_before(controller.times[swinging])


def test_it_marches_on_the_spot_within_the_sources_bounds(on_the_spot: Any) -> None:
    """Kim 2018 §2.2.1: the centre of mass within 2 cm, the orientation within 0.15 rad."""
    assert on_the_spot.stable, on_the_spot.reason
    metrics, world = on_the_spot.metrics, on_the_spot.tables["world"]
    assert metrics["steps"] >= 5
    assert metrics["orientation_error_max"] < 0.05
    settled = world.seconds > 1.4
    assert np.ptp(world["com.z"][settled]) < 0.02
    assert np.ptp(world["base.x"]) < 1e-3  # locked
    assert metrics["foot_slip_max"] < 0.03
    touches = touch_downs(on_the_spot.tables["controller"])
    stands = np.array([on_the_spot.tables["controller"]["carries.right_foot"][touch] for touch in touches])
    assert np.all(stands[1:] != stands[:-1])  # the feet take turns


def test_a_foot_lands_where_it_stood_before_the_first_step(on_the_spot: Any) -> None:
    world = on_the_spot.tables["world"]
    for foot in ("right_foot", "left_foot"):
        down = (world[f"contact.{foot}.z"] < -20.0) & (world.seconds > 1.0)
        for axis in "xy":
            place = world[f"foot.{foot}.{axis}"]
            assert np.abs(place[down] - place[0]).max() < 0.03


def test_it_stays_upright_without_a_goal() -> None:
    outcome = stepped("walk-planar", "duration=4s")
    assert outcome.stable, outcome.reason
    assert outcome.metrics["steps"] >= 6
    assert outcome.metrics["foot_placement_error_rms"] < 0.025
    assert outcome.metrics["orientation_error_max"] < 0.06


def test_it_would_fall_if_its_feet_stayed_where_they_were() -> None:
    """The centre of mass is free in x: what keeps it above the feet is where the planner puts them."""
    outcome = stepped("walk-planar", "duration=6s", "controller.stepping.planner.reach.forward=1mm")
    assert not outcome.stable


def test_it_walks_after_its_goal(forward: Any) -> None:
    assert forward.stable, forward.reason
    world = forward.tables["world"]
    gone = world["com.x"][-1] - world["com.x"][0]
    assert gone == pytest.approx(0.2 * (4.6 - 1.2), abs=0.25)
    assert min(world[f"foot.{foot}.x"][-1] for foot in ("right_foot", "left_foot")) > 0.3
    assert forward.metrics["foot_placement_error_rms"] < 0.03


def test_the_pendulum_tells_the_velocity_in_the_plane(forward: Any) -> None:
    controller, world, rows, at = falling_rows(forward)
    error = controller["pendulum.vx"][rows] - world["com_velocity.x"][at]
    assert np.sqrt(np.mean(error**2)) < 0.06


def test_the_planned_foot_is_beside_the_stance_foot(forward: Any) -> None:
    """Only x is planned: abduction holds the feet where they are in y."""
    controller, _, rows, _ = falling_rows(forward)
    swings_right = controller["carries.right_foot"][rows] == 0
    planned = controller["plan.foot.y"][rows]
    assert planned[swings_right] == pytest.approx(-0.14, abs=0.03)
    assert planned[~swings_right] == pytest.approx(0.14, abs=0.03)


LOW = "terrain.blocks=[{start='40cm', end='80cm', height='7cm'}]"  # shorter than the scenario's: down again in 7 s


def test_it_climbs_a_platform_and_comes_down_again() -> None:
    """Kim 2018 §4.3.1, Fig. 4.14, by the physics' own feet: both stand on it, then both stand behind it."""
    outcome = stepped("platform", "duration=6.6s", LOW)
    assert outcome.stable, outcome.reason
    world = outcome.tables["world"]
    feet = ("right_foot", "left_foot")
    stands = {foot: world[f"contact.{foot}.z"] < -20.0 for foot in feet}
    both = stands["right_foot"] & stands["left_foot"]
    on_top = [np.abs(world[f"foot.{foot}.z"] - 0.07) < 2e-3 for foot in feet]
    behind = [(world[f"foot.{foot}.x"] > 0.8) & (np.abs(world[f"foot.{foot}.z"]) < 2e-3) for foot in feet]
    assert (both & on_top[0] & on_top[1]).any() and (both & behind[0] & behind[1]).any()
    above = world["com.z"] - world["com.z"][world.seconds > 1.4][0]
    assert above[both & on_top[0] & on_top[1]].max() == pytest.approx(0.07, abs=0.015)
    assert outcome.metrics["orientation_error_max"] < 0.1


def test_a_platform_that_it_does_not_know_of_fells_it() -> None:
    assert not stepped("platform", "duration=6s", "controller.blocks=[]").stable


def test_both_backends_walk_alike() -> None:
    runs = [stepped("walk-forward", "duration=1.7s", backend=backend) for backend in ("inline", "processes")]
    assert runs[0].digest == runs[1].digest
    assert runs[0].tables["controller"]["state"].max() >= State.LIFTING


def test_a_walk_goes_on_from_a_snapshot_as_it_went() -> None:
    goes_on_as_it_went("walk-forward", ["duration=3s"], 400_000_000, 1_500_000_000)  # abduction is not held yet


def test_abduction_is_held_by_its_drives(forward: Any) -> None:
    controller = forward.tables["controller"]
    stands = controller.seconds > 1.0
    for joint in ("right_abduction", "left_abduction"):
        assert np.ptp(controller[f"q.{joint}"][stands]) < 0.06
