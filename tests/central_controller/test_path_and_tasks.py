"""References of the centre of mass against finite differences; the PID against its own definition."""

from __future__ import annotations

import numpy as np
import pytest

from central_controller.config import PathConfig, TaskGains, TaskSetConfig
from central_controller.path import offset
from central_controller.tasks import TaskFeedback

ELLIPSE = PathConfig(kind="ellipse", semi_x="3cm", semi_z="2cm", period="4s", start="1s")


def test_ellipse_starts_at_rest_in_its_centre_and_ends_on_the_ellipse() -> None:
    for time in (0.0, 0.99, 1.0):
        assert offset(ELLIPSE, time) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert np.abs(np.array(offset(ELLIPSE, 1.0 + 1e-4))).max() < 1e-3  # also the acceleration
    for time in np.linspace(3.0, 7.0, 17):
        (x, *_), (z, *_) = offset(ELLIPSE, time)
        assert (x / 0.03) ** 2 + (z / 0.02) ** 2 == pytest.approx(1.0)


@pytest.mark.parametrize("time", np.linspace(0.5, 6.0, 23))
def test_velocity_and_acceleration_are_the_derivatives(time) -> None:
    eps = 1e-5
    up, here, down = (np.array(offset(ELLIPSE, t)) for t in (time + eps, time, time - eps))
    assert here[:, 1] == pytest.approx((up[:, 0] - down[:, 0]) / (2 * eps), abs=1e-7)
    assert here[:, 2] == pytest.approx((up[:, 1] - down[:, 1]) / (2 * eps), abs=1e-5)


def test_hold_stays() -> None:
    assert offset(PathConfig(), 100.0) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_feedback_integrates_only_when_told_and_is_clamped() -> None:
    gains = TaskGains(kp=10.0, kd=2.0, ki=4.0)
    feedback = TaskFeedback(TaskSetConfig(com_x=gains, com_z=gains, pitch=gains, roll=gains), 0.1)
    reference = np.array([[1.0] * 4, [0.5] * 4, [0.25] * 4])
    zero = np.zeros(4)
    proportional = 0.25 + 2.0 * 0.5 + 10.0 * 1.0
    for _ in range(3):
        assert feedback.acceleration(reference, zero, zero, False) == pytest.approx(proportional)
    for i in range(1, 4):
        u = feedback.acceleration(reference, zero, zero, True)
        assert u == pytest.approx(proportional + 0.4 * i)
    state = feedback.snapshot()
    for _ in range(100):
        u = feedback.acceleration(reference, zero, zero, True)
    assert u == pytest.approx(proportional + 3.0)
    feedback.restore(state)
    assert feedback.acceleration(reference, zero, zero, False) == pytest.approx(proportional + 1.2)
