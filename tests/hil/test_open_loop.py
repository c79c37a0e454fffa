"""Steps planned beforehand, through the emulated joints and buses (Kim 2018 §7.1)."""

from typing import Any

import numpy as np
import pytest

from bus.messages import Mode
from central_controller.planning.open_loop import Motion, plan
from hil.cli import main
from hil.run import Request, assemble, run
from hil.scenario import load
from robots import description
from tests.support.snapshots import goes_on_as_it_went

ROBOT = description.load("hume")
FEET = ("right_foot", "left_foot")
# where the feet end up, from the lengths of the steps alone: right, left [m]
ENDS = {
    "open-loop": (0.15, 0.45), "open-loop-block-one": (0.15, 0.45),
    "open-loop-two": (0.75, 0.45), "open-loop-block-two": (0.75, 0.45), "open-loop-block": (0.75, 1.05),
}  # fmt: skip
EARLY = ("controller.open_loop.start=1.2s", "duration=3.5s")  # the first foot is on its way


def stepped(name: str, *settings: str, backend: str = "inline", seed: int = 0) -> Any:
    return run(Request(load(name, list(settings)), seed, backend, report=False))


def planned(name: str) -> Motion:
    scenario = load(name)
    return plan(ROBOT, scenario.controller.open_loop, scenario.controller.rate, scenario.controller.blocks or ())


@pytest.fixture(scope="module", params=list(ENDS))
def walked(request: pytest.FixtureRequest) -> tuple[str, Any]:
    return request.param, stepped(request.param)


def test_it_makes_its_steps_and_stands(walked: tuple[str, Any]) -> None:
    name, outcome = walked
    assert outcome.stable, outcome.reason
    world = outcome.tables["world"]
    for foot, end in zip(FEET, ENDS[name], strict=True):
        assert world[f"foot.{foot}.x"][-1] == pytest.approx(end, abs=0.06)
    standing = world.seconds > world.seconds[-1] - 0.2
    assert np.ptp(world["com.x"][standing]) < 0.02
    assert outcome.metrics["orientation_error_max"] < 0.1
    flights = 0
    for foot in FEET:  # clear of the ground by more than a bounce
        ground = np.where(
            (world[f"foot.{foot}.x"] > 0.33) & (world[f"foot.{foot}.x"] < 0.57) & ("block" in name), 0.08, 0
        )
        flights += np.count_nonzero(np.diff((world[f"foot.{foot}.z"] - ground > 0.03).astype(int)) > 0)
    assert flights == load(name).controller.open_loop.steps


def test_on_the_block_a_foot_stands_8_cm_higher(walked: tuple[str, Any]) -> None:
    name, outcome = walked
    world = outcome.tables["world"]
    carries = world["contact.left_foot.z"] < -50.0
    on_it = carries & (np.abs(world["foot.left_foot.x"] - 0.45) < 0.06)
    assert on_it.any()
    assert np.median(world["foot.left_foot.z"][on_it]) == pytest.approx(0.08 * ("block" in name), abs=2e-3)


def test_the_joints_are_told_the_plan(walked: tuple[str, Any]) -> None:
    name, outcome = walked
    controller, motion = outcome.tables["controller"], planned(name)
    moving = controller.seconds > load(name).controller.open_loop.start
    for n, joint in enumerate(ROBOT.joint_names):
        told = controller[f"q_reference.{joint}"][moving]
        assert told.min() == pytest.approx(motion.positions[:, n].min(), abs=1e-3)
        assert told.max() == pytest.approx(motion.positions[:, n].max(), abs=1e-3)
        assert told[-1] == pytest.approx(motion.positions[-1, n], abs=1e-6)


def test_telemetry_tells_where_the_joints_put_the_centre_of_mass(walked: tuple[str, Any]) -> None:
    """The physics' own, apart from where the feet have slid to."""
    _, outcome = walked
    controller, world = outcome.tables["controller"], outcome.tables["world"]
    moving = np.flatnonzero(controller.seconds > 2.0)
    at = world.latest_before(controller.times[moving])
    for axis, far in (("x", 0.06), ("z", 0.02)):
        assert np.abs(controller[f"com.{axis}"][moving] - world[f"com.{axis}"][at]).max() < far
    error = controller["com_velocity.x"][moving] - world["com_velocity.x"][at]
    assert np.sqrt(np.mean(error**2)) < 0.05


def test_it_would_fall_without_its_torques() -> None:
    """Positions alone push by sagging (docs/walking.md)."""
    assert not stepped("open-loop-block", "controller.open_loop.feed_forward=0").stable


def test_both_backends_step_alike() -> None:
    runs = [stepped("open-loop-block", *EARLY, backend=backend) for backend in ("inline", "processes")]
    assert runs[0].digest == runs[1].digest
    assert runs[0].tables["world"]["foot.left_foot.z"].max() > 0.05


def test_steps_go_on_from_a_snapshot_as_they_went() -> None:
    goes_on_as_it_went("open-loop-block", EARLY, 3_000_000_000, 3_450_000_000)  # from just before lift-off


def test_a_leg_is_held_from_its_motors_until_its_foot_carries() -> None:
    """By the plan, or when the switch of a standing foot opens; the foot counts again 10 ms after it has closed."""
    with assemble(Request(load("open-loop", list(EARLY)), 0, "inline")) as assembly:
        system = assembly.system
        system.run_until(2_500_000_000)
        node = system.controller._controller
        behaviour, space = node._behaviour, node._space
        setpoints = behaviour.setpoints
        hip = {foot: ROBOT.joint_names.index(foot.replace("foot", "hip")) for foot in FEET}
        seen = []
        for touches in (1, 0, *[1] * 17):
            space.contacts[:] = 1, touches
            behaviour._set(1.0)
            assert setpoints.modes[hip["right_foot"]] == Mode.JOINT_POSITION
            seen.append(setpoints.modes[hip["left_foot"]])
        assert seen[0] == Mode.JOINT_POSITION
        assert seen[1:17] == [Mode.POSITION] * 16
        assert seen[17:] == [Mode.JOINT_POSITION] * 2


@pytest.mark.parametrize(
    "setting, message",
    [
        ("controller.open_loop.wind_up=-1cm", "controller.open_loop.wind_up"),
        ("controller.open_loop.lift_off=0.4m", "lift_off (0.4 m) must be less than step_length (0.3 m)"),
        (
            "controller.open_loop.last_landing=1cm",
            "controller.open_loop: the centre of mass would fall faster than freely",
        ),
        ("controller.open_loop.com_height=1.1m", "controller.open_loop: the right_foot would be"),
        ("stance.feet_apart=0.2m", "stance.feet_apart = 0.2 m: must be controller.open_loop.step_length, 0.3 m"),
        ("terrain.blocks=[{start='33cm', end='57cm', height='60cm'}]", "out of reach"),
        ("terrain.blocks=[{start='46cm', end='57cm', height='8cm'}]", "foothold at 0.45 m is on the edge of a block"),
    ],
)
def test_a_plan_that_cannot_be_is_a_users_mistake(
    setting: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "open-loop-two", "--backend", "inline", "--set", setting]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1 and "Traceback" not in told
