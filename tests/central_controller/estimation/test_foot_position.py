"""The foot filters: their model against pinocchio, a step against finite differences, and an occlusion."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from central_controller.estimation.chain import Chain, ChainLink
from central_controller.estimation.foot_light import light_filter
from central_controller.estimation.foot_models import FootNoise
from central_controller.estimation.foot_position import FILTERS

LINKS = (ChainLink(0.31, 1.2, 0.15, 0.009), ChainLink(0.28, 0.7, 0.13, 0.006))
NOISE = FootNoise()
DT = 1 / 1500


def pinocchio_chain() -> tuple[pin.Model, pin.Data, int]:
    model, joint, reach = pin.Model(), 0, 0.0
    for k, link in enumerate(LINKS):
        place = pin.SE3(np.eye(3), np.array([reach, 0.0, 0.0]))
        joint, reach = model.addJoint(joint, pin.JointModelRZ(), place, f"j{k}"), link.length
        inertia = pin.Inertia(link.mass, np.array([link.com, 0.0, 0.0]), np.diag([1e-9, link.inertia, link.inertia]))
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    tip = pin.SE3(np.eye(3), np.array([reach, 0.0, 0.0]))
    frame = model.addFrame(pin.Frame("tip", joint, 0, tip, pin.FrameType.OP_FRAME))
    model.gravity.linear = np.array([0.0, -9.81, 0.0])
    return model, model.createData(), frame


MODEL, DATA, TIP = pinocchio_chain()
CHAIN = Chain(LINKS)


def tip(q: np.ndarray) -> np.ndarray:
    pin.framesForwardKinematics(MODEL, DATA, q)
    return DATA.oMf[TIP].translation[:2].copy()


def jacobian(function, x: np.ndarray, size: float = 1e-6) -> np.ndarray:
    return np.column_stack([(function(x + d) - function(x - d)) / (2 * size) for d in size * np.eye(len(x))])


def dynamics(x: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """[q, q̇, p] one step later, by pinocchio."""
    q, dq, p = x[:2], x[2:4], x[4:]
    acceleration = pin.aba(MODEL, DATA, q, dq, torque)
    change = dq * DT + acceleration * DT**2 / 2
    return np.concatenate([q + change, dq + acceleration * DT, p + jacobian(tip, q) @ change])


def encoders(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2, 2, 4)


@pytest.mark.parametrize("seed", range(5))
def test_the_chain_is_that_of_pinocchio(seed: int) -> None:
    q, dq, torque = np.random.default_rng(seed).uniform(-3, 3, (3, 2))
    np.testing.assert_allclose(CHAIN.forward(q), tip(q), atol=1e-14)
    np.testing.assert_allclose(CHAIN.jacobian_at(q), jacobian(tip, q), atol=1e-9)
    filter = FILTERS["EKF, configuration"](CHAIN, NOISE)
    filter.start(np.concatenate([q, dq]))
    filter.predict(DT, torque)
    np.testing.assert_allclose((filter.state[2:] - dq) / DT, pin.aba(MODEL, DATA, q, dq, torque), rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_of_the_extended_filters_by_finite_differences(seed: int) -> None:
    torque = np.array([1.0, -0.5])
    for name, size in (("EKF, configuration", 4), ("EKF, end effector", 6)):
        filter = FILTERS[name](CHAIN, NOISE)
        filter.start(encoders(seed))
        x, P = filter.state.copy(), filter.covariance.copy()

        def step(x: np.ndarray, size: int = size) -> np.ndarray:
            return dynamics(np.concatenate([x, np.zeros(6 - size)]), torque)[:size]

        filter.predict(DT, torque)
        F = jacobian(step, x)
        a = NOISE.acceleration**2 * np.eye(2)
        Q = np.zeros((size, size))
        Q[:4, :4] = np.block([[a * DT**3 / 3, a * DT**2 / 2], [a * DT**2 / 2, a * DT]])
        Q[4:, 4:] = np.eye(size - 4) * NOISE.slip**2 * DT
        np.testing.assert_allclose(filter.state, step(x), atol=1e-12)
        np.testing.assert_allclose(filter.covariance, F @ P @ F.T + Q, atol=1e-10)

        x, P = filter.state.copy(), filter.covariance.copy()
        z = np.concatenate([encoders(seed) + 0.01, tip(x[:2]) + 0.005])

        def observed(x: np.ndarray, size: int = size) -> np.ndarray:
            return x if size == 6 else np.concatenate([x, tip(x[:2])])

        H, R = jacobian(observed, x), np.diag([NOISE.encoder**2] * 2 + [NOISE.rate**2] * 2 + [NOISE.mocap**2] * 2)
        S = H @ P @ H.T + R
        gain = P @ H.T @ np.linalg.inv(S)
        filter.update(z[:4], z[4:])
        np.testing.assert_allclose(filter.state, x + gain @ (z - observed(x)), atol=1e-7)
        assert filter.nis == pytest.approx((z - observed(x)) @ np.linalg.solve(S, z - observed(x)), rel=1e-5)


def test_the_light_filter_of_hume_s_size_is_the_equations() -> None:
    rng = np.random.default_rng(0)
    light = light_filter(12, 3, NOISE)
    light.state[:] = rng.standard_normal(15)
    root = rng.standard_normal((15, 15))
    light.covariance[:] = root @ root.T
    x, P, J = light.state.copy(), light.covariance.copy(), rng.standard_normal((3, 12))
    light.predict(DT, J.ravel(order="F"))
    F = np.block([[np.eye(12), np.zeros((12, 3))], [J * DT, np.eye(3)]])  # (6.37) with its Δt
    Q = np.diag([NOISE.free_acceleration**2] * 12 + [NOISE.slip**2] * 3) * DT
    np.testing.assert_allclose(light.state, F @ x, atol=1e-14)
    np.testing.assert_allclose(light.covariance, F @ P @ F.T + Q, atol=1e-12)
    x, P = light.state.copy(), light.covariance.copy()
    z, r = rng.standard_normal(15), rng.uniform(0.1, 1, 15)
    light.correct(z, r)
    np.testing.assert_allclose(light.state, x + P @ np.linalg.solve(P + np.diag(r), z - x), atol=1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_an_occlusion_is_no_measurement(name: str) -> None:
    """Encoders that agree with the estimate, and no motion capture: the foot's uncertainty grows; seen again, it is
    what it was, and the estimate where motion capture says, whatever kinematics does."""
    filter = FILTERS[name](CHAIN, NOISE)
    start = np.array([-1.5, 1.0, 0.0, 0.0])
    filter.start(start)
    seen = CHAIN.forward(start[:2]) + np.array([0.02, 0.01])
    holding = pin.rnea(MODEL, DATA, start[:2], np.zeros(2), np.zeros(2))

    def ticks(n: int, mocap: np.ndarray | None) -> float:
        for _ in range(n):
            filter.predict(DT, holding)
            filter.update(start, mocap)
        return float(np.sqrt(np.trace(filter.position_covariance)))

    known = ticks(300, seen)
    assert known < 2 * NOISE.mocap
    where = filter.position
    if "p" in filter.fields:  # the configuration alone cannot be where no angles put it
        np.testing.assert_allclose(where, seen, atol=NOISE.mocap)
    unknown = ticks(150, None)
    assert unknown > 1.1 * known
    if "p" in filter.fields:
        assert unknown == pytest.approx(NOISE.slip * np.sqrt(2 * 150 * DT), rel=0.2)  # a random walk in two directions
        np.testing.assert_allclose(filter.position, where, atol=2e-3)
    assert ticks(300, seen) == pytest.approx(known, rel=0.02)


@pytest.mark.parametrize("name", FILTERS)
def test_a_snapshot_repeats(name: str) -> None:
    filter = FILTERS[name](CHAIN, NOISE)
    filter.start(encoders(1))

    def ticks() -> tuple[np.ndarray, np.ndarray]:
        for k in range(5):
            filter.predict(DT, np.array([0.5, -0.5]))
            filter.update(encoders(1) * (1 + 0.01 * k), None if k % 2 else np.array([0.3, 0.1]))
        return filter.state.copy(), filter.covariance.copy()

    ticks()
    state = filter.snapshot()
    first = ticks()
    filter.restore(state)
    for a, b in zip(first, ticks(), strict=True):
        np.testing.assert_array_equal(a, b)
