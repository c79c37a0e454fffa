"""The planner's observer against an integrated pendulum, filterpy's Kalman filter, and its own predicted error."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.integrate import solve_ivp

from central_controller.estimation.pendulum_observer import PendulumNoise, PendulumObserver, steady_state, transition
from hil.estimator_lab.pendulum_trial import motion, observe, velocity_off

HEIGHT, RATE, GRAVITY = 0.85, 1500.0, 9.81
DT = 1.0 / RATE
OMEGA = math.sqrt(GRAVITY / HEIGHT)


def test_the_transition_is_the_pendulum_s() -> None:
    foot, start, span = 0.07, [0.02, -0.3], 0.2
    exact = solve_ivp(lambda _, s: [s[1], OMEGA**2 * (s[0] - foot)], (0, span), start, rtol=1e-11, atol=1e-12).y[:, -1]
    A, B = transition(OMEGA, span)
    np.testing.assert_allclose(A @ start + B * foot, exact, atol=1e-9)
    observer = PendulumObserver(HEIGHT, RATE, PendulumNoise())
    observer.reset(start[0], -start[0], start[1], -start[1])
    for _ in range(round(span * RATE)):
        observer.predict(foot, -foot)
    np.testing.assert_allclose(observer.snapshot(), [exact[0], -exact[0], exact[1], -exact[1]], atol=1e-9)


def test_the_gain_is_that_to_which_a_kalman_filter_converges() -> None:
    noise = PendulumNoise()
    A, _ = transition(OMEGA, DT)
    kalman = KalmanFilter(dim_x=2, dim_z=2)
    kalman.F, kalman.H = A, np.eye(2)
    kalman.Q = noise.disturbance**2 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    kalman.R = np.diag([noise.position**2, noise.velocity**2])
    for _ in range(5000):
        kalman.predict()
        kalman.update(np.zeros(2))
    gain, covariance = steady_state(OMEGA, DT, noise)
    np.testing.assert_allclose(gain, kalman.K, rtol=1e-6)
    np.testing.assert_allclose(covariance, kalman.P, rtol=1e-6)
    observer = PendulumObserver(HEIGHT, RATE, noise)
    observer.correct(1.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(observer.snapshot(), [gain[0, 0], gain[0, 1], gain[1, 0], gain[1, 1]], rtol=1e-6)


def test_the_error_is_as_large_as_expected() -> None:
    errors = observe(motion(3, 30.0, PendulumNoise(), "white"), PendulumNoise())
    assert errors.velocity == pytest.approx(errors.expected_velocity, rel=0.1)
    assert errors.position == pytest.approx(errors.expected_position, rel=0.1)


def test_velocity_is_several_times_better_than_sensed_though_a_leg_swings() -> None:
    errors = observe(motion(4, 10.0, PendulumNoise(), "swing leg"), PendulumNoise())
    assert errors.sensed_velocity == pytest.approx(0.05, rel=0.02)
    assert errors.velocity < errors.sensed_velocity / 3


def test_what_a_foot_that_is_elsewhere_does_to_the_velocity() -> None:
    """The fixed point of e⁺ = (1 − K)(A e + B d) for a foot that is d off."""
    A, B = transition(OMEGA, DT)
    gain, _ = steady_state(OMEGA, DT, PendulumNoise())
    left = np.eye(2) - gain
    settled = np.linalg.solve(np.eye(2) - left @ A, left @ B * 0.05)
    assert velocity_off(0.05, PendulumNoise()) == pytest.approx(settled[1], rel=1e-3)
    assert abs(settled[1]) < 0.005


def test_a_moved_origin_moves_the_position_only() -> None:
    here, there = (PendulumObserver(HEIGHT, RATE, PendulumNoise()) for _ in range(2))
    for observer, origin in ((here, (0.0, 0.0)), (there, (0.3, -0.1))):
        observer.reset(0.1, 0.2, 0.3, 0.4)
        observer.shift(*origin)
        observer.predict(0.05 - origin[0], 0.1 - origin[1])
        observer.correct(0.1 - origin[0], 0.2 - origin[1], 0.3, 0.4)
    np.testing.assert_allclose(np.subtract(here.snapshot(), there.snapshot()), [0.3, -0.1, 0, 0], atol=1e-15)


def test_a_snapshot_repeats() -> None:
    observer = PendulumObserver(HEIGHT, RATE, PendulumNoise())
    observer.reset(0.1, 0.2, 0.3, 0.4)
    state = observer.snapshot()
    observer.predict(0.0, 0.0)
    after = observer.snapshot()
    assert after != state
    observer.restore(state)
    observer.predict(0.0, 0.0)
    assert observer.snapshot() == after


@pytest.mark.parametrize("what", ["position", "velocity", "disturbance"])
def test_a_noise_of_zero_is_refused(what: str) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        PendulumObserver(HEIGHT, RATE, PendulumNoise(**{what: 0.0}))


def test_it_is_cheap() -> None:
    observer = PendulumObserver(HEIGHT, RATE, PendulumNoise())
    best = math.inf
    for _ in range(20):
        began = time.perf_counter()
        for _ in range(200):
            observer.predict(0.0, 0.1)
            observer.correct(0.0, 0.1, 0.2, 0.3)
        best = min(best, (time.perf_counter() - began) / 200)
    assert best < 10e-6
