"""One-by-one corrections against filterpy's Kalman filter; Jacobians by CasADi against finite differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from central_controller.estimation.kalman import UNKNOWN, ExtendedKalmanFilter, corrected


@pytest.mark.parametrize("seed", range(5))
def test_measurements_one_by_one_are_the_same_as_all_at_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((5, 5))
    P, H, variances, y = root @ root.T, rng.standard_normal((3, 5)), rng.uniform(0.1, 2, 3), rng.standard_normal(3)
    kalman = KalmanFilter(dim_x=5, dim_z=3)
    kalman.P, kalman.H, kalman.R = P.copy(), H, np.diag(variances)
    kalman.update(y)
    change, after, nis = (np.array(ca.evalf(part)) for part in corrected(*map(ca.SX, map(ca.DM, (P, H, variances, y)))))
    np.testing.assert_allclose(change.ravel(), kalman.x.ravel(), atol=1e-12)
    np.testing.assert_allclose(after, kalman.P, atol=1e-12)
    assert nis.item() == pytest.approx(float(np.squeeze(kalman.y.T @ kalman.SI @ kalman.y)), rel=1e-10)


def pendulum() -> ExtendedKalmanFilter:
    x, u, dt = ca.SX.sym("x", 2), ca.SX.sym("u", 1), ca.SX.sym("dt")
    f = ca.vertcat(x[0] + dt * x[1], x[1] + dt * (u - 9.81 * ca.sin(x[0])))
    return ExtendedKalmanFilter("pendulum", x, u, dt, f, ca.vertcat(ca.cos(x[0]), x[1]), ca.SX.eye(2) * dt)


def test_a_nonlinear_filter_s_step_is_that_of_finite_differences() -> None:
    ekf = pendulum()
    ekf.state[:] = 0.7, -1.3
    ekf.covariance[:] = [[0.04, 0.01], [0.01, 0.09]]
    before, P, dt, u, size = ekf.state.copy(), ekf.covariance.copy(), 0.02, 1.5, 1e-6

    def f(x: np.ndarray) -> np.ndarray:
        return np.array([x[0] + dt * x[1], x[1] + dt * (u - 9.81 * np.sin(x[0]))])

    def h(x: np.ndarray) -> np.ndarray:
        return np.array([np.cos(x[0]), x[1]])

    def jacobian(function, x: np.ndarray) -> np.ndarray:
        return np.column_stack([(function(x + d) - function(x - d)) / (2 * size) for d in size * np.eye(2)])

    ekf.predict(dt, np.array([u]))
    F = jacobian(f, before)
    P = F @ P @ F.T + np.eye(2) * dt
    np.testing.assert_allclose(ekf.state, f(before), atol=1e-14)
    np.testing.assert_allclose(ekf.covariance, P, atol=1e-9)
    x, R, z = ekf.state.copy(), np.array([0.1, 0.2]), np.array([0.6, -1.0])
    ekf.correct(z, R)
    H = jacobian(h, x)
    S = H @ P @ H.T + np.diag(R)
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(ekf.state, x + K @ (z - h(x)), atol=1e-8)
    np.testing.assert_allclose(ekf.covariance, (np.eye(2) - K @ H) @ P, atol=1e-8)
    assert ekf.nis == pytest.approx((z - h(x)) @ np.linalg.solve(S, z - h(x)), rel=1e-6)


def test_a_measurement_that_is_not_there_changes_nothing() -> None:
    with_it, without = pendulum(), pendulum()
    for ekf in (with_it, without):
        ekf.covariance[:] = np.diag([0.04, 0.09])
    with_it.correct(np.array([-100.0, 0.3]), np.array([UNKNOWN, 0.1]))
    without.correct(np.array([1.0, 0.3]), np.array([UNKNOWN, 0.1]))
    np.testing.assert_allclose(with_it.state, without.state, atol=1e-5)
    assert with_it.state[1] > 0.1


def test_a_snapshot_repeats() -> None:
    ekf = pendulum()
    ekf.covariance[:] = np.eye(2)
    state = ekf.snapshot()
    ekf.predict(0.1, np.array([1.0]))
    ekf.correct(np.array([0.5, 0.5]), np.array([0.1, 0.1]))
    after = ekf.snapshot()
    ekf.restore(state)
    ekf.predict(0.1, np.array([1.0]))
    ekf.correct(np.array([0.5, 0.5]), np.array([0.1, 0.1]))
    np.testing.assert_array_equal(ekf.state, after[0])
    np.testing.assert_array_equal(ekf.covariance, after[1])
    assert ekf.nis == after[2] > 0
