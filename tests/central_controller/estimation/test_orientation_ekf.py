"""The orientation filter: Jacobians against finite differences on the manifold, with pinocchio's rotations; the
correction against filterpy on the error state; consistency; what the foot's sensors are worth."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from filterpy.kalman import KalmanFilter

from central_controller.estimation import orientation_ekf
from central_controller.estimation.orientation_ekf import OrientationFilter, OrientationNoise

RATE = 500.0
SIZE = 1e-6
_Q, _Z, _M, _S = (ca.SX.sym(name, 4) for name in "qzms")
_B, _W, _DT = ca.SX.sym("b", 3), ca.SX.sym("w", 3), ca.SX.sym("dt")
PREDICTION = ca.Function("prediction", [_Q, _B, _W, _DT], list(orientation_ekf.prediction(_Q, _B, _W, _DT)))
INNOVATION = ca.Function("innovation", [_Q, _Z, _M, _S], list(orientation_ekf.innovation(_Q, _Z, _M, _S)))


def coefficients(rotation: np.ndarray) -> np.ndarray:
    return pin.Quaternion(rotation).coeffs()


def matrix(quaternion: np.ndarray) -> np.ndarray:
    return pin.Quaternion(np.asarray(quaternion).ravel()).toRotationMatrix()


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return pin.exp3(rng.uniform(-2, 2, 3))


@pytest.mark.parametrize("seed", range(5))
def test_the_prediction_and_its_jacobian(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, bias, rate, dt = random_rotation(rng), rng.uniform(-1, 1, 3), rng.uniform(-4, 4, 3), 1 / RATE

    def after(errors: np.ndarray) -> np.ndarray:
        """Orientation, foot (which stays) and bias after a step from a state that is off by ``errors``."""
        value, _ = PREDICTION(coefficients(pin.exp3(errors[:3]) @ rotation), bias + errors[6:], rate, dt)
        return matrix(value)

    centre = after(np.zeros(9))
    np.testing.assert_allclose(centre, rotation @ pin.exp3((rate + bias) * dt), atol=1e-14)
    F = np.array(PREDICTION(coefficients(rotation), bias, rate, dt)[1])
    numeric = np.column_stack([(pin.log3(after(e) @ centre.T) - pin.log3(after(-e) @ centre.T)) / (2 * SIZE)
                               for e in SIZE * np.eye(9)])  # fmt: skip
    np.testing.assert_allclose(F[:3], numeric, atol=1e-9)
    np.testing.assert_array_equal(F[3:], np.eye(9)[3:])
    np.testing.assert_allclose(F[:3, 6:], rotation * dt, atol=1e-2 * dt)  # the first order, Kim 2018 (6.24)


@pytest.mark.parametrize("seed", range(5))
def test_the_innovation_and_its_jacobian(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base, foot = random_rotation(rng), random_rotation(rng)

    def innovation(errors: np.ndarray) -> np.ndarray:
        """Of the estimate (base, foot) when the truth is off by ``errors``, and sensors that tell the truth."""
        true_base, true_foot = pin.exp3(errors[:3]) @ base, pin.exp3(errors[3:6]) @ foot
        y, _ = INNOVATION(*(coefficients(r) for r in (base, foot, true_foot.T @ true_base, true_foot)))
        return np.array(y).ravel()

    np.testing.assert_allclose(innovation(np.zeros(9)), 0.0, atol=1e-14)
    H = np.array(INNOVATION(*(coefficients(r) for r in (base, foot, foot.T @ base, foot)))[1])
    numeric = np.column_stack([(innovation(e) - innovation(-e)) / (2 * SIZE) for e in SIZE * np.eye(9)])
    np.testing.assert_allclose(H, numeric, atol=1e-9)


def test_the_printed_observation_is_what_joints_know_only_of_a_foot_that_is_not_turned() -> None:
    """Kim 2018 (6.8), q ⊗ z⁻¹ with quaternions of body to world (A.2): turn the whole robot, and joints that have not
    moved would read something else."""
    rng = np.random.default_rng(0)
    relative = random_rotation(rng)
    upright = np.eye(3)
    turned = pin.exp3(np.array([0.0, 0.0, 1.0]))
    printed = [foot @ relative @ foot.T for foot in (upright, turned)]
    derived = [foot.T @ (foot @ relative) for foot in (upright, turned)]
    np.testing.assert_allclose(printed[0], relative, atol=1e-14)
    assert np.linalg.norm(pin.log3(printed[0].T @ printed[1])) > 0.3
    np.testing.assert_allclose(derived[0], derived[1], atol=1e-14)


def test_a_step_is_that_of_filterpy_on_the_error_state() -> None:
    rng = np.random.default_rng(1)
    noise = OrientationNoise()
    ours = OrientationFilter(RATE, noise)
    base, relative = random_rotation(rng), random_rotation(rng)
    ours.reset(coefficients(base), coefficients(relative))
    ours.bias[:] = rng.uniform(-0.1, 0.1, 3)
    foot, bias, rate = matrix(ours.foot), ours.bias.copy(), rng.uniform(-3, 3, 3)
    reference = foot @ pin.exp3(np.array([0.01, -0.02, 0.03]))
    ours._reference[:] = coefficients(reference)
    kalman = KalmanFilter(dim_x=9, dim_z=6)
    kalman.P = ours.covariance.copy()
    kalman.F = np.array(PREDICTION(coefficients(base), bias, rate, 1 / RATE)[1])
    Q = np.diag(np.repeat([noise.gyro, noise.foot, noise.bias], 3) ** 2) / RATE
    kalman.Q = kalman.F @ Q @ kalman.F.T
    kalman.predict()
    ours.predict(rate, flat=True)
    base = base @ pin.exp3((rate + bias) / RATE)
    np.testing.assert_allclose(ours.covariance, kalman.P, atol=1e-15)
    sensed = foot.T @ base @ pin.exp3(rng.uniform(-0.01, 0.01, 3))
    kalman.H = np.array(INNOVATION(*[np.array([0, 0, 0, 1.0])] * 4)[1])
    kalman.R = np.diag(np.repeat([noise.kinematics, noise.level], 3) ** 2)
    y = np.concatenate([pin.log3(foot @ sensed @ base.T), pin.log3(reference @ foot.T)])
    kalman.update(y)
    ours.correct(coefficients(sensed), flat=True)
    change = kalman.x.ravel()
    np.testing.assert_allclose(matrix(ours.orientation), pin.exp3(change[:3]) @ base, atol=1e-9)
    np.testing.assert_allclose(matrix(ours.foot), pin.exp3(change[3:6]) @ foot, atol=1e-9)
    np.testing.assert_allclose(ours.bias, bias + change[6:], atol=1e-9)
    np.testing.assert_allclose(ours.covariance, kalman.P, atol=1e-12)
    assert ours.nis == pytest.approx(float(np.squeeze(y @ kalman.SI @ y)), rel=1e-6)


def test_a_foot_that_is_not_flat_tells_nothing_of_level() -> None:
    """Its tilt turns the estimate of the foot, and of the body hardly; one taken for flat takes the body along."""
    tilted = coefficients(pin.exp3(np.array([0.0, -0.1, 0.0])))  # the base seen from a foot that has pitched by 0.1 rad
    turned = {}
    for flat in (False, True):
        estimator = OrientationFilter(RATE, OrientationNoise())
        for _ in range(50):
            estimator.predict(np.zeros(3), flat)
            estimator.correct(tilted, flat)
        turned[flat] = [float(np.linalg.norm(pin.log3(matrix(q)))) for q in (estimator.orientation, estimator.foot)]
    assert turned[False][0] < 1e-3 and turned[False][1] == pytest.approx(0.1, rel=0.01)
    assert turned[True][0] > 0.01 and turned[True][1] < 0.09


def test_the_next_stance_foot_is_where_the_joints_see_it() -> None:
    rng = np.random.default_rng(5)
    estimator = OrientationFilter(RATE, OrientationNoise())
    base, relative = pin.rpy.rpyToMatrix(0.02, -0.01, 0.7), pin.exp3(np.array([0.02, -0.01, 0.3]))
    estimator.reset(coefficients(base), coefficients(base))
    for _ in range(20):
        estimator.predict(np.zeros(3), True)
        estimator.correct(coefficients(base), True)
    before = estimator.covariance.copy()
    assert before[0, 0] != before[3, 3]
    estimator.stand_on(coefficients(relative))
    np.testing.assert_allclose(matrix(estimator.foot) @ relative, matrix(estimator.orientation), atol=1e-14)
    # errors of foot and base are one, up to what the joints do not know: drawn, their covariance is that of the filter
    errors = rng.multivariate_normal(np.zeros(9), before, 200_000)
    errors[:, 3:6] = errors[:, :3] + OrientationNoise().kinematics * rng.standard_normal((200_000, 3))
    np.testing.assert_allclose(estimator.covariance, np.cov(errors.T), atol=0.02 * before.max())
    yaw = pin.rpy.matrixToRpy(matrix(estimator.foot))[2]
    np.testing.assert_allclose(matrix(estimator._reference), pin.rpy.rpyToMatrix(0.0, 0.0, yaw), atol=1e-14)


def test_a_snapshot_repeats() -> None:
    rng = np.random.default_rng(6)
    estimator = OrientationFilter(RATE, OrientationNoise())
    rates, seen = rng.uniform(-1, 1, (5, 3)), [coefficients(pin.exp3(v)) for v in rng.uniform(-0.1, 0.1, (5, 3))]

    def steps() -> list[np.ndarray]:
        for rate, relative in zip(rates, seen, strict=True):
            estimator.predict(rate, True)
            estimator.correct(relative, True)
        return estimator.snapshot()

    steps()
    state = estimator.snapshot()
    first = steps()
    estimator.restore(state)
    for a, b in zip(first, steps(), strict=True):
        np.testing.assert_array_equal(a, b)
