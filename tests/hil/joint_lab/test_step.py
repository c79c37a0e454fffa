"""Figures of merit of a step response: a second-order system's, and the emulation's against its sampled theory."""

import math

import numpy as np
import pytest

from hil.joint_lab import sampled, step
from hil.joint_lab.step import StepResponse


def second_order(damping, wn=100.0, target=20.0):
    t = np.arange(-0.01, 0.4, 1e-5)
    wd, sigma = wn * math.sqrt(1 - damping**2), damping * wn
    y = target * (1 - np.exp(-sigma * t) * (np.cos(wd * t) + sigma / wd * np.sin(wd * t)))
    return StepResponse(t, np.where(t < 0, 0.0, y), target)


def test_overshoot_is_the_textbook_s():
    for damping in (0.2, 0.5, 0.7):
        expected = math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
        assert second_order(damping).overshoot == pytest.approx(expected, rel=1e-4)


def test_rise_time_is_the_textbook_s():
    """A first-order lag rises from 10 % to 90 % in ln 9 time constants."""
    t = np.arange(-0.01, 0.5, 1e-5)
    response = StepResponse(t, np.where(t < 0, 0.0, 5.0 * (1 - np.exp(-t / 0.03))), 5.0)
    assert response.rise_time == pytest.approx(0.03 * math.log(9.0), rel=1e-4)
    assert response.overshoot == 0.0
    assert response.steady_error == pytest.approx(0.0, abs=1e-4)


def test_a_response_that_never_gets_there_has_no_rise_time_but_an_error():
    t = np.linspace(-0.1, 1.0, 500)
    response = StepResponse(t, np.where(t < 0, 0.0, 12.0 + 0.3 * np.sin(100 * t)), 20.0)
    assert response.rise_time is None
    assert response.steady_error == pytest.approx(8.0, abs=0.1)
    assert response.ripple == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("law", ["PD_m", "cascade"])
def test_the_emulation_steps_as_its_linear_model(experiment, law):
    setup = experiment("hume", "left_knee", law, settings=["firmware.torque_rate=1e6 N m/s"])
    found = step.run(setup, 10.0, 0.2)
    system = sampled.closed_loop(setup.plant(), setup.law())
    x, reports = np.zeros(len(system.a)), []
    for tick in range(int(0.2 * setup.firmware.rate)):
        if tick % setup.ticks_per_report == 0:
            reports.append(setup.torque_per_sensed * (system.c @ x)[1])
        x = system.a @ x + system.b[:, 0] * 10.0
    measured = found.torque[found.seconds >= 0][: len(reports)]
    np.testing.assert_allclose(measured, reports[: len(measured)], atol=0.25)


def test_dry_friction_leaves_an_error_that_the_integral_takes_away(experiment):
    errors = {}
    for law, friction in (("PD_m", 0.0), ("PD_m", 1.0), ("cascade", 1.0)):
        setup = experiment("hume", "left_knee", law, friction_scale=friction)
        errors[law, friction] = abs(step.run(setup, 20.0, 0.5).steady_error)
    assert errors["PD_m", 1.0] > 5 * errors["PD_m", 0.0]
    assert errors["cascade", 1.0] < 0.5 * errors["PD_m", 1.0]
