"""Rotations against pinocchio; the filters against what they are to converge to."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from central_controller.config import ControllerConfig
from central_controller.estimator import Hanging, filter_constants, turned, yaw_corrected
from central_controller.rotations import compose, exponential, inverse, logarithm, rotation_matrix

_A, _B, _R, _F, _C = (ca.SX.sym(name, size) for name, size in (("a", 4), ("b", 4), ("r", 3), ("f", 3), ("c", 5)))
MATRIX = ca.Function("matrix", [_A], [rotation_matrix(_A)])
COMPOSE = ca.Function("compose", [_A, _B], [compose(_A, _B)])
INVERSE = ca.Function("inverse", [_A], [inverse(_A)])
LOGARITHM = ca.Function("logarithm", [_A], [logarithm(_A)])
EXPONENTIAL = ca.Function("exponential", [_R], [exponential(_R)])
TURNED = ca.Function("turned", [_A, _R, _F, _C], [turned(_A, _R, _F, _C)])
CONFIG = ControllerConfig()
FILTERS = filter_constants(CONFIG)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def quaternion(rotation: np.ndarray) -> np.ndarray:
    return pin.Quaternion(rotation).coeffs()


def matrix(quaternion: np.ndarray) -> np.ndarray:
    return np.array(MATRIX(quaternion))


@pytest.mark.parametrize("seed", range(5))
def test_rotations_are_those_of_pinocchio(seed) -> None:
    rng = np.random.default_rng(seed)
    a, b = (pin.exp3(rng.uniform(-2, 2, 3)) for _ in range(2))
    assert matrix(quaternion(a)) == pytest.approx(a, abs=1e-14)
    assert matrix(COMPOSE(quaternion(a), quaternion(b))) == pytest.approx(a @ b, abs=1e-14)
    for size in (0.0, 1e-200, 1e-12, 1e-3, 1.0, 3.0):
        vector = size * rng.uniform(-1, 1, 3)
        assert matrix(EXPONENTIAL(vector)) == pytest.approx(pin.exp3(vector), abs=1e-14)
        if size < 3.0:  # the shortest vector of a rotation by more than π is another one
            assert np.array(LOGARITHM(EXPONENTIAL(vector))).ravel() == pytest.approx(vector, abs=1e-14)
            assert np.array(LOGARITHM(-EXPONENTIAL(vector))).ravel() == pytest.approx(vector, abs=1e-14)
    assert matrix(INVERSE(quaternion(a))) == pytest.approx(a.T, abs=1e-14)


def test_a_product_of_many_rotations_stays_a_rotation() -> None:
    total, step = ca.DM(UPRIGHT), EXPONENTIAL([0.01, -0.02, 0.03])
    for _ in range(5000):
        total = COMPOSE(total, step)
    assert matrix(total) == pytest.approx(pin.exp3(5000 * np.array([0.01, -0.02, 0.03])), abs=1e-11)
    assert float(ca.norm_2(total)) == pytest.approx(1.0, abs=1e-15)


def test_the_gyro_is_integrated_and_the_accelerometer_pulls() -> None:
    rate, still = np.array([0.3, -0.5, 0.7]), np.zeros(3)
    after = matrix(TURNED(UPRIGHT, rate, still, FILTERS))  # without specific force there is no down
    assert after == pytest.approx(pin.exp3(rate / CONFIG.rate), abs=1e-14)
    tilted = quaternion(pin.rpy.rpyToMatrix(0.02, -0.03, 0.4))
    ticks = round(CONFIG.orientation_time_constant * CONFIG.rate)
    for _ in range(ticks):
        tilted = TURNED(tilted, still, [0.0, 0.0, 9.81], FILTERS)
    # exp(-1) of the tilt is left after a time constant, and yaw is not touched
    assert pin.rpy.matrixToRpy(matrix(tilted)) == pytest.approx(np.array([0.02, -0.03, np.e * 0.4]) / np.e, abs=1e-3)


@pytest.mark.parametrize("heading", [0.3, 3.1, -3.1])
def test_yaw_is_held_by_the_line_between_the_feet(heading) -> None:
    feet, kept, standing = ca.SX.sym("feet", 3, 2), ca.SX.sym("kept"), ca.SX.sym("standing")
    law = ca.Function("yaw", [_A, feet, kept, standing, _C], yaw_corrected(_A, feet, kept, standing, _C))

    def line(angle: float) -> np.ndarray:
        return np.array([[np.cos(angle), np.sin(angle), 0.0], [0.0, 0.0, 0.0]]).T

    unmoved, reference = law(UPRIGHT, line(heading), 7.0, 0, FILTERS)
    assert float(reference) == pytest.approx(heading) and np.array(unmoved).ravel() == pytest.approx(UPRIGHT)
    yaw = 0.0
    for _ in range(round(2.5 * CONFIG.rate)):  # five time constants; the feet's line turns with the estimate
        turn = pin.rpy.rpyToMatrix(0.0, 0.0, yaw)
        corrected, reference = law(quaternion(turn), line(heading + 0.1 + yaw), reference, 1, FILTERS)
        yaw = pin.rpy.matrixToRpy(matrix(corrected))[2]
    assert yaw == pytest.approx(-0.1, abs=1e-3) and float(reference) == pytest.approx(heading)


def test_hanging_tells_the_gyros_zero_and_where_down_is() -> None:
    hanging = Hanging(100.0)
    rotation, zero = pin.rpy.rpyToMatrix(0.1, -0.2, 0.0), np.array([0.01, -0.02, 0.03])
    for _ in range(30):  # still swinging
        hanging.take(np.ones(3), np.ones(3))
    for sign in (1, -1) * 20:
        hanging.take(zero + sign * 0.1, rotation.T @ [0.0, 0.0, 9.81 + sign])
    # the last sample that swung counts as the first: none is no mean
    assert hanging.zero == pytest.approx((zero * 40 + 1.0) / 41)
    assert matrix(hanging.quaternion) == pytest.approx(rotation, abs=0.01)


@pytest.mark.parametrize("force", [[0, 0, 0], [1e-9, 0, 0], [-9.81, 0, 0], [9.81, 1e-300, 0], [0, 0, -9.81]])
def test_hanging_survives_any_specific_force(force) -> None:
    hanging = Hanging(100.0)
    for _ in range(3):
        hanging.take(np.zeros(3), np.array(force))
    assert np.linalg.norm(hanging.quaternion) == pytest.approx(1.0)
    size = np.linalg.norm(force)
    if size:
        assert matrix(hanging.quaternion)[2] == pytest.approx(np.array(force) / size, abs=1e-9)


def test_a_restored_estimate_continues() -> None:
    one, other = Hanging(100.0), Hanging(100.0)
    for k in range(50):
        one.take(np.full(3, k), np.full(3, 9.0))
    other.restore(one.snapshot())
    for hanging in (one, other):
        hanging.take(np.ones(3), np.array([1.0, 2.0, 3.0]))
    assert np.array_equal(one.zero, other.zero) and np.array_equal(one.quaternion, other.quaternion)
