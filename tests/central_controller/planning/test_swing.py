"""The swing foot: where it begins and ends, continuity, derivatives, re-planning, late ground."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from central_controller.planning.config import PlannerConfig, StepTiming, SwingConfig
from central_controller.planning.pendulum import Foot
from central_controller.planning.swing import SwingTrajectory

CONFIG, TIMING = SwingConfig(), StepTiming()
START, TARGET = Foot(0.1, 0.15, 0.02), Foot(0.3, 0.2, 0.05)


def lifted() -> SwingTrajectory:
    swing = SwingTrajectory(CONFIG)
    swing.lift(1.0, START, TIMING.lifting)
    return swing


def test_it_rises_straight_to_the_height_and_stops_there() -> None:
    swing = lifted()
    assert swing.at(1.0) == pytest.approx((*START, 0, 0, 0, *swing.at(1.0)[6:]))
    for t in np.linspace(1.0, 1.0 + TIMING.lifting, 7):
        assert swing.at(t)[:2] == START[:2]
    top = swing.at(1.0 + TIMING.lifting)
    assert top == pytest.approx((START.x, START.y, START.z + CONFIG.height, 0, 0, 0, 0, 0, 0))


def test_it_lands_on_the_planned_foot_at_the_touchdown_speed() -> None:
    swing = lifted()
    swing.land(1.0 + TIMING.lifting, TARGET, TIMING.landing)
    end = swing.at(1.0 + TIMING.lifting + TIMING.landing - 1e-12)
    assert end[:6] == pytest.approx((*TARGET, 0.0, 0.0, -CONFIG.touchdown_speed), abs=1e-9)


def test_over_an_edge_it_keeps_its_height_before_it_goes_down() -> None:
    swing = SwingTrajectory(SwingConfig(level=0.4))
    step_up, start = 0.07, 1.0 + TIMING.lifting
    swing.lift(1.0, START, TIMING.lifting, step_up)
    swing.land(start, TARGET, TIMING.landing)
    top, down = swing.at(start)[2], start + 0.4 * TIMING.landing
    assert top == pytest.approx(START.z + CONFIG.height + step_up)
    for t in np.linspace(start + 1e-3, down - 1e-3, 5):
        point = swing.at(t)
        assert point[2] == pytest.approx(top) and point[5] == point[8] == 0.0
        assert START.x < point[0] < TARGET.x and point[3] > 0.0
    before, after = swing.at(down - 1e-9), swing.at(down + 1e-9)
    assert after[:6] == pytest.approx(before[:6], abs=1e-6)
    end = swing.at(start + TIMING.landing - 1e-12)
    assert end[:6] == pytest.approx((*TARGET, 0.0, 0.0, -CONFIG.touchdown_speed), abs=1e-9)
    late = swing.at(start + TIMING.landing + 0.01)
    assert late[2] == pytest.approx(TARGET.z - 0.01 * CONFIG.touchdown_speed)


def test_late_ground_is_looked_for_slowly_and_not_for_ever() -> None:
    swing = lifted()
    swing.land(2.0, TARGET, TIMING.landing)
    later = swing.at(2.0 + TIMING.landing + 0.1)
    assert later[:6] == pytest.approx((TARGET.x, TARGET.y, TARGET.z - 0.1 * CONFIG.touchdown_speed, 0, 0, -0.1))
    for_ever = swing.at(100.0)
    assert for_ever == pytest.approx((TARGET.x, TARGET.y, TARGET.z - CONFIG.search_depth, *[0.0] * 6))


def test_while_it_rises_it_may_go_across() -> None:
    """To the target as a whole, by a cubic of its own; the height does not know of it."""
    straight, swing = lifted(), lifted()
    aimed = 1.0 + 0.3 * TIMING.lifting
    landing, end = 1.0 + TIMING.lifting, 1.0 + TIMING.lifting + TIMING.landing
    swing.aim(aimed, TARGET, end - aimed)
    for t in np.linspace(1.0, landing, 9):
        assert swing.at(t)[2::3] == straight.at(t)[2::3]
    whole = TARGET.x - START.x
    middle = swing.at((aimed + end) / 2)  # by symmetry half way, at 3/2 of the mean speed
    assert (middle[0] - START.x, middle[3]) == pytest.approx((whole / 2, 1.5 * whole / (end - aimed)))
    before = swing.at(landing)
    swing.land(landing, TARGET, TIMING.landing)
    assert swing.at(landing)[:6] == pytest.approx(before[:6], abs=1e-12)
    assert swing.at(end - 1e-12)[:3] == pytest.approx(TARGET, abs=1e-9)


@given(again=st.floats(0.0, 0.14), x=st.floats(-0.3, 0.3), y=st.floats(0.0, 0.4))
def test_planning_again_does_not_jump(again: float, x: float, y: float) -> None:
    swing = lifted()
    swing.land(2.0, TARGET, TIMING.landing)
    before = swing.at(2.0 + again)
    swing.land(2.0 + again, Foot(x, y), TIMING.landing - again)
    assert swing.at(2.0 + again)[:6] == pytest.approx(before[:6], abs=1e-12)
    assert swing.at(2.0 + TIMING.landing)[:3] == pytest.approx((x, y, 0.0), abs=1e-12)


def test_velocities_and_accelerations_are_the_derivatives() -> None:
    swing = lifted()
    swing.land(2.0, TARGET, TIMING.landing)
    d = 1e-5
    for t in (2.01, 2.07, 2.14, 2.2):
        before, here, after = (np.array(swing.at(t + k * d)) for k in (-1, 0, 1))
        assert here[3:6] == pytest.approx((after - before)[:3] / (2 * d), abs=1e-6)
        assert here[6:9] == pytest.approx((after - before)[3:6] / (2 * d), abs=1e-5)


def test_a_snapshot_brings_it_back() -> None:
    swing = lifted()
    kept, point = swing.snapshot(), swing.at(1.05)
    swing.land(1.05, TARGET, 0.1)
    assert swing.at(1.06) != pytest.approx(point)
    swing.restore(kept)
    assert swing.at(1.05) == point


def test_the_planner_is_done_before_the_landing_begins() -> None:
    """Kim 2018 §4.3.1: planning at 70 % of the lifting leaves 43 ms for it."""
    assert (1.0 - PlannerConfig().replan_at) * TIMING.lifting == pytest.approx(0.0435)
