"""The pendulum's integration: against closed forms, scipy's integrator, and what a physical pendulum conserves."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from central_controller.planning.height_surface import Plane, platform
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState, on_level

states = st.builds(
    PendulumState, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)
)


@given(state=states, height=st.floats(0.4, 1.2), time=st.floats(0.01, 0.6))
def test_on_a_level_surface_it_is_the_closed_form(state: PendulumState, height: float, time: float) -> None:
    foot = Foot(0.05, -0.1, 0.02)
    expected = on_level(state, foot, height, time)
    assert Pendulum(Plane(height + 0.02)).advance(state, foot, time, 0.01) == pytest.approx(expected, abs=2e-5)


def test_on_a_slope_through_the_foot_it_has_its_own_frequency() -> None:
    """z = a (x − p_x) + b: ω = √(g/b) whatever the slope, Kim 2018 (4.9) as corrected."""
    foot, a, b = Foot(0.1, 0.0), 0.3, 0.8
    state = PendulumState(0.05, 0.02, 0.3, -0.1)
    moved = Pendulum(Plane(b - a * foot.x, a)).advance(state, foot, 0.3, 0.005)
    assert moved == pytest.approx(on_level(state, foot, b, 0.3), abs=1e-8)


def test_on_a_platform_it_is_what_scipy_makes_of_the_source_s_equation() -> None:
    """(B.1) with (B.8) as printed, integrated by an independent method."""
    surface, g, foot = platform(0.86, 0.07, 0.3, 0.9, 0.25), 9.81, Foot(0.1, -0.1)

    def printed(_: float, s: np.ndarray) -> list[float]:
        x, y, vx, vy = s
        z, zx, zy, zxx, zxy, zyy = surface(x, y)
        lean = g / z * (zx * (x - foot.x) + zy * (y - foot.y))
        ddz = (zxx * vx**2 + zyy * vy**2 + lean + 2 * zxy * vx * vy) / (1 - lean / g)
        return [vx, vy, (g + ddz) / z * (x - foot.x), (g + ddz) / z * (y - foot.y)]

    start = PendulumState(0.05, -0.03, 0.6, 0.2)
    exact = solve_ivp(printed, (0.0, 0.5), start, rtol=1e-10, atol=1e-12, max_step=1e-3).y[:, -1]
    # where the curvature jumps, an integration in fixed steps is of first order
    assert Pendulum(surface).advance(start, foot, 0.5, 0.01) == pytest.approx(exact, abs=3e-3)
    assert Pendulum(surface).advance(start, foot, 0.5, 0.0001) == pytest.approx(exact, abs=5e-5)


def test_the_slider_slows_x_alone() -> None:
    """Kim 2018 (7.5) on a level surface: ω² = M/(M + m_s) g/z in x."""
    ratio = 23.35 / (23.35 + 5.0)
    state, foot = PendulumState(0.05, 0.02, 0.3, -0.1), Foot(0.0, 0.0)
    moved = Pendulum(Plane(0.8), mass_ratio=ratio).advance(state, foot, 0.3, 0.005)
    slow, fast = on_level(state, foot, 0.8 / ratio, 0.3), on_level(state, foot, 0.8, 0.3)
    assert (moved.x, moved.vx) == pytest.approx((slow.x, slow.vx))
    assert (moved.y, moved.vy) == pytest.approx((fast.y, fast.vy))


def test_the_path_ends_where_the_state_does() -> None:
    pendulum, foot, start = Pendulum(Plane(0.86)), Foot(0.0, -0.1), PendulumState(0.02, 0.0, 0.1, 0.0)
    path = pendulum.path(start, foot, 0.3, 0.01)
    assert path.shape == (31, 5)
    assert path[0].tolist() == [0.0, *start]
    assert path[-1] == pytest.approx([0.3, *on_level(start, foot, 0.86, 0.3)], abs=1e-7)


def test_the_leg_pushes_along_itself() -> None:
    """Gravity aside, the force points from the foot to the centre of mass, on any surface."""
    surface = platform(0.86, 0.07, 0.3, 0.9, 0.25)
    state, foot = PendulumState(0.2, -0.03, 0.6, 0.2), Foot(0.1, -0.1, 0.03)
    ax, ay = Pendulum(surface).acceleration(state, foot)
    z, zx, zy, zxx, _, _ = surface(state.x, state.y)
    az = zxx * state.vx**2 + zx * ax + zy * ay
    direction = np.array([state.x - foot.x, state.y - foot.y, z - foot.z])
    assert np.cross(direction, [ax, ay, az + 9.81]) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    assert math.isfinite(az)
