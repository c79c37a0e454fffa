"""The planner's observer against an integrated pendulum, filterpy's Kalman filter, and its own predicted error."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.integrate import solve_ivp

from central_controller.estimation.pendulum_observer import PendulumNoise, PendulumObserver, steady_state, transition

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


def stepping(seconds: float, seed: int, disturbed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True [x, y, vx, vy] and feet [x, y] at each tick of a pendulum that steps in place, and what the sensors say.

    A step of 0.32 s reverses the velocity; ``disturbed``: by white acceleration as the noise states it, else by a swing
    leg's half sine of 0.8 m/s², which the observer does not know.
    """
    random = np.random.default_rng(seed)
    noise, ticks = PendulumNoise(), round(seconds * RATE)
    truth, feet = np.zeros((ticks, 4)), np.zeros((ticks, 2))
    A, B = transition(OMEGA, DT)
    duration = 0.32
    state, began = np.array([0.0, 0.0, 0.2, 0.3]), 0
    foot = np.zeros(2)
    for k in range(ticks):
        if k % round(duration * RATE) == 0:  # undisturbed, the velocity is the opposite one a step later
            foot = state[:2] + state[2:] * math.cosh(OMEGA * duration / 2) / (OMEGA * math.sinh(OMEGA * duration / 2))
            began = k
        for axis in range(2):
            push = noise.disturbance * math.sqrt(DT) * random.standard_normal()
            if not disturbed:
                push = 0.8 * math.sin(2 * math.pi * (k - began) * DT / duration) * DT
            state[axis::2] = A @ state[axis::2] + B * foot[axis] + np.array([push * DT / 2, push])
        truth[k], feet[k] = state, foot
    deviations = [noise.position, noise.position, noise.velocity, noise.velocity]
    sensed = truth + deviations * random.standard_normal(truth.shape)
    return truth, feet, sensed


def errors(truth: np.ndarray, feet: np.ndarray, sensed: np.ndarray) -> np.ndarray:
    observer = PendulumObserver(HEIGHT, RATE, PendulumNoise())
    observer.reset(*sensed[0])
    estimates = np.zeros_like(truth)
    for k, (foot, measured) in enumerate(zip(feet.tolist(), sensed.tolist(), strict=True)):
        observer.predict(*foot)
        observer.correct(*measured)
        estimates[k] = observer.snapshot()
    return (estimates - truth)[round(0.5 * RATE) :]


def test_the_error_is_as_large_as_predicted() -> None:
    error = errors(*stepping(30.0, seed=3, disturbed=True))
    position, velocity = PendulumObserver(HEIGHT, RATE, PendulumNoise()).deviation
    assert np.std(error[:, 2:]) == pytest.approx(velocity, rel=0.1)
    assert np.std(error[:, :2]) == pytest.approx(position, rel=0.1)


def test_velocity_is_several_times_better_than_sensed_though_a_leg_swings() -> None:
    truth, feet, sensed = stepping(10.0, seed=4, disturbed=False)
    raw = np.sqrt(np.mean((sensed - truth)[:, 2:] ** 2))
    rms = np.sqrt(np.mean(errors(truth, feet, sensed)[:, 2:] ** 2))
    assert raw == pytest.approx(0.05, rel=0.02)
    assert rms < raw / 3


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
