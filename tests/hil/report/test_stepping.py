"""The plots of a run that steps."""

import numpy as np
import pytest

from central_controller.planning.pendulum import Foot, PendulumState, on_level
from hil.analysis.steps import steps_of
from hil.record.signals import Signals
from hil.report.stepping import draw_stepping, figures
from hil.report.stepping.placement import _ellipse
from hil.report.stepping.portraits import predictions, shown, switch_rows
from hil.report.stepping.tracking import tracking
from hil.scenario import load
from tests.support.stepping import FIRST, HEIGHT, PLAN, STEP, stepping_run

CONFIGURATION = load("balance").model_dump(mode="json")
ERRORS = [(0.01, 0.0), (0.0, -0.02), (-0.01, 0.01), (0.0, 0.0)]


@pytest.fixture(scope="module")
def tables() -> dict[str, Signals]:
    return stepping_run(ERRORS)


def test_a_run_of_steps_gets_all_plots_and_another_one_none(tables: dict[str, Signals]) -> None:
    plots = draw_stepping({"configuration": CONFIGURATION}, tables)
    assert [plot.title for plot in plots] == [
        "Phase portraits of the steps", "Foot placement errors", "Ways of the feet from above", "Timing of the steps",
        "Orientation while stepping", "Torque tracking by state",
    ]  # fmt: skip
    controller = tables["controller"]
    standing = Signals(controller.times, ("state",), controller.data[:, :1])
    assert figures(CONFIGURATION, {**tables, "controller": standing}) == {}


def test_a_record_full_of_gaps_is_drawn(tables: dict[str, Signals]) -> None:
    world = Signals(tables["world"].times, tables["world"].names, np.full_like(tables["world"].data, np.nan))
    assert all(plot.png for plot in draw_stepping({"configuration": CONFIGURATION}, {**tables, "world": world}))


def test_the_switch_is_half_way_between_touch_down_and_the_next_lift(tables: dict[str, Signals]) -> None:
    steps = steps_of(tables["controller"], tables["world"])
    rows = switch_rows(tables["controller"], steps)
    assert rows[:3] == [FIRST + n * STEP + (270 + STEP + 20) // 2 for n in range(3)]  # 50 ms to double, 20 to unload


def test_what_is_predicted_is_the_pendulum_that_the_record_follows(tables: dict[str, Signals]) -> None:
    controller = tables["controller"]
    steps = steps_of(controller, tables["world"])
    rows = dict(zip([s.number for s in steps], switch_rows(controller, steps), strict=True))
    for n, step in enumerate(steps[:3]):
        both = predictions(CONFIGURATION, controller, step, rows)
        assert both is not None
        before, after = both
        begin = FIRST + n * STEP + PLAN
        times = begin + np.round(1000 * before[:, 0]).astype(int)
        followed = controller.vector("pendulum.x", "pendulum.y", "pendulum.vx", "pendulum.vy")[times]
        assert before[:, 1:] == pytest.approx(followed, abs=2e-5)
        assert after[0, 1:] == pytest.approx(before[-1, 1:], abs=2e-5)  # one path, bent at the switch
        assert after[-1, 0] == pytest.approx((rows[step.number + 1] - rows[step.number]) / 1000)
        ahead = [on_level(PendulumState(*after[0, 1:]), Foot(*step.planned), HEIGHT, t) for t in after[:, 0]]
        assert after[:, 1:] == pytest.approx(np.array(ahead), abs=2e-5)


def test_what_is_not_planned_is_not_predicted(tables: dict[str, Signals]) -> None:
    controller = tables["controller"]
    step, following, *_ = steps_of(controller, tables["world"])
    rows = dict(zip((1, 2), switch_rows(controller, [step, following]), strict=True))
    both = predictions(load("walk-planar").model_dump(mode="json"), controller, step, rows)
    assert both is not None
    for path in both:
        assert np.isnan(path[:, [2, 4]]).all() and np.isfinite(path[:, [1, 3]]).all()
    assert predictions(load("step-in-place").model_dump(mode="json"), controller, step, rows) is None


def test_of_many_steps_the_first_and_the_last_are_drawn(tables: dict[str, Signals]) -> None:
    steps = steps_of(tables["controller"], tables["world"])
    assert shown(steps) == steps
    many = shown(steps * 5)
    assert len(many) == 8 and many[:4] == steps and many[-4:] == steps


def test_the_ellipse_is_that_of_the_mean_squares() -> None:
    angle = 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    ellipse = _ellipse(turn @ np.diag([9.0, 4.0]) @ turn.T)
    assert (ellipse.width, ellipse.height) == pytest.approx((6.0, 4.0))
    assert np.radians(ellipse.angle) % np.pi == pytest.approx(angle)


def test_torques_are_compared_by_joint_and_state() -> None:
    tables = stepping_run(ERRORS)
    controller = tables["controller"]
    for n, error in enumerate((3.0, 5.0, 4.0, 5.0)):  # while landing; the right foot swings in the first and third step
        begin = FIRST + n * STEP
        controller["torque_command.left_knee"][begin + 120 : begin + 270] = error
    found = tracking(controller, steps_of(controller, tables["world"]))
    assert list(found) == ["right_foot", "left_foot"]
    expected = np.zeros((2, 5))
    for foot, rms in (("right_foot", np.sqrt(12.5)), ("left_foot", 5.0)):
        expected[1, 2] = rms
        assert found[foot] == pytest.approx(expected)
