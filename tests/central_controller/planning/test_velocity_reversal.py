"""The planner: what it promises, against closed forms; reach; the longer swing; walking with the pendulum."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from central_controller.planning.config import PlannerConfig, ReachConfig, StepTiming
from central_controller.planning.gait import Gait
from central_controller.planning.height_surface import CosineProfile, Plane, platform
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState, on_level
from central_controller.planning.reach import LEFT, RIGHT, clear_of_edges, nearest_reachable
from central_controller.planning.rehearsal import rehearse
from central_controller.planning.velocity_reversal import VelocityReversalPlanner
from robots.terrain import Block

HEIGHT, T = 0.86, StepTiming().step_time
FREE = {"reach": dict.fromkeys(("forward", "lateral_max", "hip_forward", "hip_inward", "hip_outward"), "9m")}
FREE["reach"] |= {"lateral_min": "-9m"}
PROMPT = {"extension": {"limit": "0s"}}
PLATFORM = platform(HEIGHT, 0.07, 0.2, 0.9, 0.3)

states = st.builds(
    PendulumState, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)
)


def planner(surface=Plane(HEIGHT), **config) -> VelocityReversalPlanner:
    return VelocityReversalPlanner(PlannerConfig.model_validate(config), Pendulum(surface))


@given(state=states, far=st.floats(0.11, 5.0))
def test_a_goal_far_away_pulls_no_harder_than_one_at_the_distance_that_counts(state: PendulumState, far: float) -> None:
    stance, config = Foot(0.02, -0.1), {**FREE, **PROMPT, "goal_distance": "0.1m"}
    switching = on_level(state, stance, HEIGHT, 0.2)
    near, away = (
        planner(**config).plan(state, stance, LEFT, 0.2, (switching.x + d, switching.y - d)).foot for d in (0.11, far)
    )
    assert away == pytest.approx(near, abs=1e-9)


@given(state=states)
def test_on_a_level_surface_the_foot_is_that_of_the_formula(state: PendulumState) -> None:
    """Kim 2018 (4.32) and the pull towards the goal that reproduces Table 7.2."""
    config, stance, goal = PlannerConfig(), Foot(0.02, -0.1), (0.1, -0.05)
    plan = planner(**FREE, **PROMPT).plan(state, stance, LEFT, 0.2, goal)
    switching = on_level(state, stance, HEIGHT, 0.2)
    omega = math.sqrt(9.81 / HEIGHT)
    for axis, time, kappa in ((0, config.reversal_time_x, config.kappa_x), (1, config.reversal_time_y, config.kappa_y)):
        place = (1 + kappa) * switching[axis] - kappa * goal[axis]
        place += switching[axis + 2] / (omega * math.tanh(omega * time))
        assert plan.foot[axis] == pytest.approx(place, abs=1e-5)
    assert plan.switching == pytest.approx(switching, abs=1e-6)
    assert plan.converged and not plan.projected


@given(state=states)
def test_in_the_plane_only_x_is_planned_with_the_slider_s_mass(state: PendulumState) -> None:
    """Kim 2018 (7.5): on a level surface the slider makes gravity smaller by r, for x."""
    ratio, stance, goal = 0.82, Foot(0.02, -0.14), (0.1, 3.0)
    config = PlannerConfig.model_validate({**FREE, "lateral": False})
    pendulum = Pendulum(Plane(HEIGHT), mass_ratio=ratio)
    plan = VelocityReversalPlanner(config, pendulum).plan(state, stance, LEFT, 0.2, goal)
    switching = on_level(state, stance, HEIGHT, 0.2, ratio * 9.81)
    omega = math.sqrt(ratio * 9.81 / HEIGHT)
    place = (1 + config.kappa_x) * switching.x - config.kappa_x * goal[0]
    place += switching.vx / (omega * math.tanh(omega * config.reversal_time_x))
    assert plan.foot.x == pytest.approx(place, abs=1e-5)
    assert (plan.switching.x, plan.switching.vx) == pytest.approx((switching.x, switching.vx), abs=1e-6)
    assert plan.foot.y == plan.switching.y == stance.y and plan.extension == 0.0 and not plan.projected


@given(state=states)
def test_on_a_platform_both_velocities_vanish_in_their_times(state: PendulumState) -> None:
    plan = planner(PLATFORM, kappa_x=0, kappa_y=0, integration_step="2ms", **FREE, **PROMPT).plan(
        state, Foot(0.0, -0.1), LEFT, 0.15, (0.0, 0.0), 0.0
    )
    assert plan.converged and plan.iterations <= 10
    config, pendulum = PlannerConfig(), Pendulum(PLATFORM)
    at_x = pendulum.advance(plan.switching, plan.foot, config.reversal_time_x, 1e-3)
    at_y = pendulum.advance(plan.switching, plan.foot, config.reversal_time_y, 1e-3)
    assert at_x.vx == pytest.approx(0.0, abs=2e-3)
    assert at_y.vy == pytest.approx(0.0, abs=2e-3)


@given(state=states, here=st.floats(-0.3, 0.3), apart=st.floats(0.001, 0.3))
def test_the_velocity_falls_with_the_foot_s_place(state: PendulumState, here: float, apart: float) -> None:
    """(4.25): where z'' > −g/x'² and the foot is below, the velocity after t' falls with p_x."""
    pendulum = Pendulum(PLATFORM)
    curvature = 0.035 * (math.pi / 0.3) ** 2  # the surface's greatest
    assume(curvature * (abs(state.vx) + 1.0) ** 2 < 9.81)
    before, after = (pendulum.advance(state, Foot(p, 0.0), 0.185, 0.005).vx for p in (here, here + apart))
    assert after < before


def test_the_derivative_is_that_of_the_source() -> None:
    """∂x'/∂p_x of (4.25) for a level surface is −sinh(ωt')/ω · g/h; the printed integral holds the path fixed."""
    pendulum, d, omega = Pendulum(Plane(HEIGHT)), 1e-3, math.sqrt(9.81 / HEIGHT)
    start = PendulumState(0.02, 0.0, 0.3, 0.0)
    speeds = [pendulum.advance(start, Foot(p, 0.0), 0.185, 0.005).vx for p in (-d, d)]
    assert (speeds[1] - speeds[0]) / (2 * d) == pytest.approx(-omega * math.sinh(omega * 0.185), rel=1e-6)


def test_steps_are_brought_into_reach() -> None:
    reach, stance = ReachConfig(), Foot(0.0, -0.1)
    assert nearest_reachable(reach, LEFT, (0.1, 0.1), stance, (0.05, 0.0)) == (0.1, 0.1)
    assert nearest_reachable(reach, LEFT, (1.0, -0.3), stance, (0.1, 0.0)) == (0.35, pytest.approx(0.0))
    assert nearest_reachable(reach, RIGHT, (-1.0, 0.3), Foot(0.0, 0.1), (0.0, 0.0)) == (-0.35, pytest.approx(0.0))
    mirrored = nearest_reachable(reach, RIGHT, (0.1, -0.9), Foot(0.0, 0.1), (0.0, -0.02))
    assert mirrored == pytest.approx((0.1, -nearest_reachable(reach, LEFT, (0.1, 0.9), stance, (0.0, 0.02))[1]))


@given(side=st.sampled_from([LEFT, RIGHT]), x=st.floats(-2, 2), y=st.floats(-2, 2), hips=st.floats(-1, 1))
def test_legs_never_cross(side: int, x: float, y: float, hips: float) -> None:
    reach, stance = ReachConfig(), Foot(0.1, 0.05)
    foot = nearest_reachable(reach, side, (x, y), stance, (0.0, hips))
    assert reach.lateral_min - 1e-12 <= side * (foot[1] - stance.y) <= reach.lateral_max + 1e-12
    assert abs(foot[0] - stance.x) <= reach.forward


def cycle(config: PlannerConfig, steps: int, step_time: float = T, surface=Plane(HEIGHT), **walk):
    pendulum = Pendulum(surface)
    omega = math.sqrt(9.81 / HEIGHT)
    start = PendulumState(0.0, 0.0, 0.0, -0.14 * omega * math.tanh(omega * config.reversal_time_y))
    own = VelocityReversalPlanner(config, pendulum)
    return rehearse(own, pendulum, start, Foot(0.0, -0.14), LEFT, step_time, steps, **walk)


def widths(walked) -> np.ndarray:
    return np.array([abs(step.plan.foot.y - step.stance.y) for step in walked])


def test_left_alone_the_feet_come_together() -> None:
    """Kim 2018 §4.3.2: "the footsteps converge towards the location of the CoM"; with the slower λ_y per step."""
    shrinking = widths(cycle(PlannerConfig.model_validate(FREE | PROMPT), 12))
    eigenvalues = Gait(HEIGHT, T, 0.4, 0.18).eigenvalues()
    assert shrinking[-1] / shrinking[-2] == pytest.approx(-eigenvalues[1].real, abs=0.03)
    assert shrinking[-1] < 0.12


def test_a_longer_swing_keeps_them_apart() -> None:
    config = PlannerConfig()
    walked = cycle(config, 60)
    assert widths(walked)[5:].min() > config.extension.step_width
    assert widths(walked)[5:].max() < 0.3
    speeds = np.array([abs(step.plan.switching.vy) for step in walked[5:]])
    assert speeds.min() >= config.extension.lateral_speed - 1e-9
    extensions = np.array([step.plan.extension for step in walked])
    assert 0.0 < extensions[5:].max() < config.extension.limit
    assert not any(step.plan.projected for step in walked)


@given(x=st.floats(-1.0, 2.0))
def test_no_foot_is_put_on_an_edge(x: float) -> None:
    block = Block.model_validate({"start": "40cm", "end": "120cm", "height": "7cm"})
    place = clear_of_edges([block], x, 0.04)
    assert min(abs(place - edge) for edge in (block.start, block.end)) >= 0.04 - 1e-9
    assert abs(place - x) <= 0.04 + 1e-9
    assert all((place - edge) * (x - edge) >= 0.0 for edge in (block.start, block.end))
    if min(abs(x - edge) for edge in (block.start, block.end)) > 0.04:
        assert place == x


@pytest.mark.parametrize("bias", [0.005, 0.01])
def test_a_bias_keeps_them_as_far_apart_as_the_analysis_says(bias: float) -> None:
    config = PlannerConfig.model_validate(FREE | PROMPT | {"lateral_bias": f"{bias}m"})
    assert widths(cycle(config, 80))[-1] == pytest.approx(Gait(HEIGHT, T, 0.4, 0.18).step_width(bias), rel=1e-3)


def test_nothing_is_put_off_when_the_centre_of_mass_falls_inwards() -> None:
    inwards = PendulumState(0.0, -0.12, 0.0, -0.1)  # beyond the stance foot
    assert planner().plan(inwards, Foot(0.0, -0.1), LEFT, 0.1, (0.0, 0.0)).extension == 0.0


def test_it_follows_a_goal_over_the_platform() -> None:
    """Kim 2018 Fig. 4.14: the goal passes over a platform of 7 cm, the centre of mass over its height surface."""
    start, end, ramp = 0.5, 1.3, 0.3
    surface = CosineProfile(
        [(start - ramp, HEIGHT), (start, HEIGHT + 0.07), (end, HEIGHT + 0.07), (end + ramp, HEIGHT)]
    )
    walked = cycle(
        PlannerConfig(), 60, surface=surface,
        goal=lambda time: (0.12 * time, 0.0), ground=lambda x: 0.07 if start < x < end else 0.0,
    )  # fmt: skip
    assert {step.stance.z for step in walked} == {0.0, 0.07}
    assert walked[-1].stance.x > end
    assert all(step.plan.converged for step in walked)
    assert max(abs(step.path[:, 4]).max() for step in walked) < 0.6


def test_a_hopeless_state_still_gives_a_reachable_foot() -> None:
    plan = planner(PLATFORM).plan(PendulumState(50.0, 1e6, 1e8, -1e9), Foot(0.0, -0.1), LEFT, 0.2, (0.0, 0.0))
    assert all(map(math.isfinite, plan.foot))
    assert plan.projected
