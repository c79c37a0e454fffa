"""Whole-body control against the direct solution of the constrained dynamics, Kim 2018 (2.4)."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from central_controller.model import COORDINATES, RobotModel
from central_controller.wbosc import whole_body_control
from robots import description

ROBOT = description.load("hume")


def random_state(model: RobotModel, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random configuration with bent knees and feet apart, and a random velocity."""
    joints = np.array([0.05, -0.9, 1.3, -0.05, -0.3, 1.3]) + 0.2 * rng.uniform(-1, 1, 6)
    rotation = pin.exp3(0.4 * rng.uniform(-1, 1, 3))
    q = np.concatenate([rng.uniform(-1, 1, 3), pin.Quaternion(rotation).coeffs(), joints])
    return q, rng.uniform(-1, 1, model.nv)


def solve_constrained(model: RobotModel, J: np.ndarray, bias: np.ndarray, tau: np.ndarray) -> tuple:
    """Acceleration and force of the robot on the environment from (2.4), no projections."""
    n, m = model.nv, len(bias)
    matrix = np.block([[model.A, J.T], [J, np.zeros((m, m))]])
    generalised = np.concatenate([np.zeros(6), tau]) - model.h
    solution = np.linalg.solve(matrix, np.concatenate([generalised, -bias]))
    return solution[:n], solution[n:]


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel(ROBOT)


@pytest.fixture(scope="module")
def double() -> ca.Function:
    return whole_body_control(2, 4)


@pytest.mark.parametrize("seed", range(25))
def test_double_support_yields_commanded_accelerations_and_internal_force(model, double, seed) -> None:
    rng = np.random.default_rng(seed)
    model.update(*random_state(model, rng))
    u, sensed = 5 * rng.standard_normal(4), 30 * rng.standard_normal(6)
    line = model.feet[0] - model.feet[1]
    line /= np.linalg.norm(line)
    direction = np.concatenate([line, -line])
    out = double(model.A, model.h, model.Js, model.Jsdot_dq, model.Jt, model.Jtdot_dq, u, sensed, line, 100.0)
    tau, predicted, felt, internal = (np.array(o).ravel() for o in out)
    ddq, force = solve_constrained(model, model.Js, model.Jsdot_dq, tau)
    scale = max(1.0, np.abs(ddq).max())
    assert np.abs(model.Jt @ ddq + model.Jtdot_dq - u).max() < 1e-8 * scale
    assert direction @ force == pytest.approx(100.0, rel=1e-8)
    assert predicted == pytest.approx(force, rel=1e-7, abs=1e-6)
    # (5.3): the sensed internal force is that of the constrained dynamics under the sensed torques
    _, force = solve_constrained(model, model.Js, model.Jsdot_dq, sensed)
    assert felt == pytest.approx(force, rel=1e-7, abs=1e-6)
    assert internal[0] == pytest.approx(direction @ force, rel=1e-8, abs=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_double_support_agrees_with_the_equations_by_pseudo_inverse(model, double, seed) -> None:
    """(2.7)–(2.18) as written, with errata 1 and 2, by numpy's SVD."""
    rng = np.random.default_rng(100 + seed)
    model.update(*random_state(model, rng))
    u = rng.standard_normal(4)
    inverse = np.linalg.inv(model.A)
    J, U = model.Js, np.hstack([np.zeros((6, 6)), np.eye(6)])
    lambda_s = np.linalg.inv(J @ inverse @ J.T)
    Jbar = inverse @ J.T @ lambda_s
    N = np.eye(12) - Jbar @ J
    UN = U @ N
    UNbar = inverse @ UN.T @ np.linalg.pinv(UN @ inverse @ UN.T, rcond=1e-9)
    Jstar = model.Jt @ UNbar
    mobility = UN @ inverse @ UN.T
    force = np.linalg.inv(Jstar @ mobility @ Jstar.T) @ (
        u - model.Jtdot_dq + model.Jt @ Jbar @ model.Jsdot_dq + model.Jt @ inverse @ N.T @ model.h
    )
    L = np.eye(6) - UN @ UNbar
    line = model.feet[0] - model.feet[1]
    line /= np.linalg.norm(line)
    W = np.concatenate([line, -line])[None, :]
    from_task = W @ (Jbar.T @ (U.T @ Jstar.T @ force - model.h) + lambda_s @ model.Jsdot_dq)
    reduced = L @ U @ Jbar @ W.T
    tau_int = np.linalg.pinv(reduced.T, rcond=1e-9) @ (100.0 - from_task)
    tau = Jstar.T @ force + L.T @ tau_int
    zero = np.zeros(6)
    out = double(model.A, model.h, J, model.Jsdot_dq, model.Jt, model.Jtdot_dq, u, zero, line, 100.0)
    assert np.array(out[0]).ravel() == pytest.approx(tau, rel=1e-6, abs=1e-6)


def swing_tasks(model: RobotModel, foot: int) -> tuple[np.ndarray, ...]:
    """J and bias of the standing ``foot``, Jacobian and bias of [CoM_z, pitch, roll, other foot]."""
    stand, swing = slice(3 * foot, 3 * foot + 3), slice(3 - 3 * foot, 6 - 3 * foot)
    Jt = np.vstack([model.Jt[1:], model.Js[swing]])
    Jtdot = np.concatenate([model.Jtdot_dq[1:], model.Jsdot_dq[swing]])
    return model.Js[stand], model.Jsdot_dq[stand], Jt, Jtdot


@pytest.mark.parametrize("foot", [0, 1])
@pytest.mark.parametrize("seed", range(10))
def test_single_support_yields_commanded_accelerations(model, foot, seed) -> None:
    """Also while the other foot presses on the ground with a force that the law knows."""
    rng = np.random.default_rng(seed)
    model.update(*random_state(model, rng))
    J, bias, Jt, Jtdot = swing_tasks(model, foot)
    u, sensed = 5 * rng.standard_normal(6), 30 * rng.standard_normal(6)
    push = 50 * rng.standard_normal(3)
    out = whole_body_control(1, 6)(model.A, model.h, J, bias, Jt, Jtdot, u, sensed, push)
    tau, predicted, felt = (np.array(o).ravel() for o in out)
    n = model.nv
    pressed = np.concatenate([np.zeros(6), tau]) - model.h - Jt[-3:].T @ push  # the ground's force is its opposite
    matrix = np.block([[model.A, J.T], [J, np.zeros((3, 3))]])
    ddq = np.linalg.solve(matrix, np.concatenate([pressed, -bias]))[:n]
    assert np.abs(Jt @ ddq + Jtdot - u).max() < 1e-8 * max(1.0, np.abs(ddq).max())
    _, force = solve_constrained(model, J, bias, tau)
    assert predicted == pytest.approx(force, rel=1e-7, abs=1e-6)
    assert felt == pytest.approx(solve_constrained(model, J, bias, sensed)[1], rel=1e-7, abs=1e-6)


@pytest.mark.parametrize("foot", [0, 1])
@pytest.mark.parametrize("seed", range(5))
def test_the_whole_push_of_double_support_makes_the_switch_smooth(model, double, foot, seed) -> None:
    """Kim 2018 §2.2.1: single support with the artificial force at its full size is double support."""
    rng = np.random.default_rng(200 + seed)
    model.update(*random_state(model, rng))
    line = model.feet[0] - model.feet[1]
    line /= np.linalg.norm(line)
    u, zero = 5 * rng.standard_normal(4), np.zeros(6)
    out = double(model.A, model.h, model.Js, model.Jsdot_dq, model.Jt, model.Jtdot_dq, u, zero, line, 20.0)
    tau, reaction = (np.array(o).ravel() for o in out[:2])
    J, bias, Jt, Jtdot = swing_tasks(model, foot)
    single = whole_body_control(1, 6)
    still = np.concatenate([u[1:], np.zeros(3)])  # the same of the body; the other foot stays
    push = reaction[3 - 3 * foot : 6 - 3 * foot]
    pushing = np.array(single(model.A, model.h, J, bias, Jt, Jtdot, still, zero, push)[0])
    without = np.array(single(model.A, model.h, J, bias, Jt, Jtdot, still, zero, np.zeros(3))[0])
    assert pushing.ravel() == pytest.approx(tau, rel=1e-7, abs=1e-6)
    assert np.abs(without.ravel() - tau).max() > 1.0


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_and_biases_against_finite_differences(model, seed) -> None:
    rng = np.random.default_rng(seed)
    q, v = random_state(model, rng)
    eps = 1e-6

    def values(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model.update(at, v)
        return np.concatenate([model.task, model.feet.ravel()]), model.Jt.copy(), model.Js.copy()

    up = values(pin.integrate(model.model, q, eps * v))
    down = values(pin.integrate(model.model, q, -eps * v))
    model.update(q, v)
    rate = (up[0] - down[0]) / (2 * eps)
    assert model.Jt @ v == pytest.approx(rate[:4], abs=1e-6)
    assert model.task_velocity == pytest.approx(rate[:4], abs=1e-6)
    assert model.Js @ v == pytest.approx(rate[4:], abs=1e-6)
    assert model.Jtdot_dq == pytest.approx((up[1] - down[1]) / (2 * eps) @ v, abs=1e-5)
    assert model.Jsdot_dq == pytest.approx((up[2] - down[2]) / (2 * eps) @ v, abs=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_every_coordinate_against_finite_differences(seed) -> None:
    rng = np.random.default_rng(seed)
    model = RobotModel(ROBOT, COORDINATES)
    q, v = random_state(model, rng)
    eps = 1e-6

    def values(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        model.update(at, v)
        return model.task.copy(), model.Jt.copy()

    up, down = (values(pin.integrate(model.model, q, sign * eps * v)) for sign in (1.0, -1.0))
    model.update(q, v)
    assert model.Jt.shape == (6, 12)
    assert model.Jt @ v == pytest.approx((up[0] - down[0]) / (2 * eps), abs=1e-6)
    assert model.task_velocity == pytest.approx((up[0] - down[0]) / (2 * eps), abs=1e-6)
    assert model.Jtdot_dq == pytest.approx((up[1] - down[1]) / (2 * eps) @ v, abs=1e-5)


def test_masses(model) -> None:
    assert pin.computeTotalMass(model.model) == pytest.approx(23.3522)
