"""References of the centre of mass against finite differences; the PID against its own definition."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from central_controller.config import PathConfig, TaskGains, TaskSetConfig
from central_controller.path import offset, path_constants
from central_controller.tasks import feedback, task_gains

ELLIPSE = PathConfig(kind="ellipse", semi_x="3cm", semi_z="2cm", period="4s", start="1s")
_CONSTANTS, _T = ca.SX.sym("constants", 3), ca.SX.sym("t")
_OFFSET = ca.Function("offset", [_CONSTANTS, _T], [offset(_CONSTANTS, _T)])


def at(config: PathConfig, t: float) -> np.ndarray:
    """Rows position, velocity, acceleration; columns x, z; ``t`` seconds after the start."""
    return np.array(_OFFSET(path_constants(config), t))


def test_ellipse_starts_at_rest_in_its_centre_and_ends_on_the_ellipse() -> None:
    for t in (-1.0, -0.01, 0.0):
        assert np.array_equal(at(ELLIPSE, t), np.zeros((3, 2)))
    assert np.abs(at(ELLIPSE, 1e-4)).max() < 1e-3  # also the acceleration
    for t in np.linspace(2.0, 6.0, 17):
        x, z = at(ELLIPSE, t)[0]
        assert (x / 0.03) ** 2 + (z / 0.02) ** 2 == pytest.approx(1.0)


@pytest.mark.parametrize("t", np.linspace(-0.5, 5.0, 23))
def test_velocity_and_acceleration_are_the_derivatives(t) -> None:
    eps = 1e-5
    up, here, down = (at(ELLIPSE, s) for s in (t + eps, t, t - eps))
    assert here[1] == pytest.approx((up[0] - down[0]) / (2 * eps), abs=1e-7)
    assert here[2] == pytest.approx((up[1] - down[1]) / (2 * eps), abs=1e-5)


def test_hold_stays() -> None:
    assert np.array_equal(at(PathConfig(), 100.0), np.zeros((3, 2)))


def test_feedback_integrates_only_when_told_and_is_clamped() -> None:
    gains = TaskGains(kp=10.0, kd=2.0, ki=4.0)
    table = task_gains(TaskSetConfig(com_x=gains, com_z=gains, pitch=gains, roll=gains), 0.1)
    shapes = [(3, 4), (3, 4), (4, 1), (4, 1), (4, 1), (1, 1)]
    symbols = [ca.SX.sym("x", *shape) for shape in shapes]
    law = ca.Function("feedback", symbols, feedback(*symbols))
    reference = np.array([[1.0] * 4, [0.5] * 4, [0.25] * 4])
    zero = np.zeros(4)

    def acceleration(integral: np.ndarray, integrate: bool) -> tuple[np.ndarray, np.ndarray]:
        u, integral = law(table, reference, zero, zero, integral, integrate)
        return np.array(u).ravel(), np.array(integral).ravel()

    proportional = 0.25 + 2.0 * 0.5 + 10.0 * 1.0
    integral = zero
    for _ in range(3):
        u, integral = acceleration(integral, False)
        assert u == pytest.approx(proportional)
    for i in range(1, 4):
        u, integral = acceleration(integral, True)
        assert u == pytest.approx(proportional + 0.4 * i)
    state = integral
    for _ in range(100):
        u, integral = acceleration(integral, True)
    assert u == pytest.approx(proportional + 3.0)
    assert acceleration(state, False)[0] == pytest.approx(proportional + 1.2)


def test_each_task_has_its_own_gains() -> None:
    config = TaskSetConfig()
    table = task_gains(config, 0.5)
    for column, gains in enumerate((config.com_x, config.com_z, config.pitch, config.roll)):
        assert table[:, column] == pytest.approx([gains.kp, gains.kd, 0.5 * gains.ki])
