"""The analysis from step to step: against the simulated map, numpy's eigenvalues, and the source's table."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from central_controller.planning.config import PlannerConfig, StepTiming
from central_controller.planning.gait import Gait, place, with_magnitude
from central_controller.planning.height_surface import Plane
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.reach import LEFT
from central_controller.planning.velocity_reversal import VelocityReversalPlanner

gaits = st.builds(Gait, st.floats(0.4, 1.2), st.floats(0.15, 0.6), st.floats(-0.5, 1.5), st.floats(0.05, 0.6))


@given(gait=gaits)
def test_eigenvalues_are_those_of_the_matrix(gait: Gait) -> None:
    expected = np.sort_complex(np.linalg.eigvals(gait.step_map()))
    assert np.sort_complex(np.array(gait.eigenvalues())) == pytest.approx(expected, abs=1e-6)


@given(gait=gaits)
def test_the_limits_of_stability_are_those_of_the_eigenvalues(gait: Gait) -> None:
    low, high = gait.stable_reversal_times()
    assume(abs(gait.magnitude - 1.0) > 1e-6)
    assert (gait.magnitude < 1.0) == (gait.kappa > 0.0 and low < gait.reversal_time < high)


def test_the_map_is_that_of_the_planner_and_the_pendulum() -> None:
    """Finite differences of one planned and integrated step, in x: from switch to switch, the goal at the origin."""
    config = PlannerConfig.model_validate({
        "reach": {"forward": "9m", "hip_forward": "9m"}, "extension": {"limit": "0s"},
    })  # fmt: skip
    pendulum = Pendulum(Plane(0.86))
    planner = VelocityReversalPlanner(config, pendulum)
    gait = Gait(0.86, 0.335, config.kappa_x, config.reversal_time_x)

    def step(x: float, vx: float) -> np.ndarray:
        at_switch = PendulumState(x, 0.0, vx, 0.3)
        plan = planner.plan(at_switch, Foot(0.0, -0.1), LEFT, 0.0, (0.0, 0.0))
        after = pendulum.advance(plan.switching, plan.foot, gait.step_time, 0.005)
        return np.array([after.x, after.vx])

    d = 1e-3
    found = np.column_stack([(step(d, 0.0) - step(-d, 0.0)) / (2 * d), (step(0.0, d) - step(0.0, -d)) / (2 * d)])
    assert found == pytest.approx(gait.step_map(), abs=1e-5)


def test_the_table_s_eigenvalues() -> None:
    """Table 7.2, with T the sum of its four states. λ_y comes out as printed. λ_x does not with t'_x = 0.185 s as
    printed, its second one is −0.75; with 0.175 s both would be: the printed time looks like a misprint."""
    height, step_time = 0.86, StepTiming().step_time
    assert step_time == pytest.approx(0.335)
    assert Gait(height, step_time, 0.4, 0.18).eigenvalues() == pytest.approx((0.69, -0.81), abs=0.011)
    as_printed = Gait(height, step_time, 0.4, 0.185).eigenvalues()
    assert as_printed == pytest.approx((0.675, -0.753), abs=0.001)
    assert Gait(height, step_time, 0.4, 0.175).eigenvalues() == pytest.approx((0.70, -0.88), abs=0.011)


def test_the_printed_sign_of_kappa_does_not_stabilise() -> None:
    assert Gait(0.86, 0.335, -0.4, 0.18).magnitude > 1.0


@given(
    height=st.floats(0.4, 1.2), step_time=st.floats(0.2, 0.5), first=st.floats(0.5, 0.9), second=st.floats(-0.9, -0.5)
)
def test_eigenvalues_can_be_placed(height: float, step_time: float, first: float, second: float) -> None:
    try:
        gait = place(height, step_time, first, second)
    except ValueError:
        coth_at_infinity = 1.0  # refused: a coth of less than 1 would be needed
        c, s = (f(math.sqrt(9.81 / height) * step_time) for f in (math.cosh, math.sinh))
        kappa = (1 - first - second + first * second) / (2 * (c - 1))
        assert (2 * c - first - second + (1 + kappa) * (1 - c)) / s <= coth_at_infinity
        return
    assert gait.eigenvalues() == pytest.approx((first, second), abs=1e-6)


@given(kappa=st.floats(0.3, 0.8), magnitude=st.floats(0.75, 0.95))
def test_a_reversal_time_for_a_magnitude(kappa: float, magnitude: float) -> None:
    wanted = with_magnitude(Gait(0.86, 0.335, kappa, 1.0), magnitude)
    assert wanted.magnitude == pytest.approx(magnitude)
    assert wanted.kappa == kappa


def test_an_impossible_magnitude_is_refused() -> None:
    with pytest.raises(ValueError, match=r"kappa 0.05 .* no reversal time"):
        with_magnitude(Gait(0.86, 0.335, 0.05, 0.2), 0.5)
