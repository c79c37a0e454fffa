"""The linear model of the hydraulic joint against finite differences of the plant, and what the firmware has of it."""

import numpy as np
import pytest
from scipy.linalg import expm

from hil.joint_lab import hydraulics
from joint_firmware.laws.valve import current_per_velocity
from plant.actuators.bank import Symbols
from plant.actuators.model import ActuatorModel
from plant.bench import Inertia, Locked, Pendulum
from robots import description

SMOOTH = {"coulomb": 0.0, "static": 0.0, "valve_offset": 0.0}
ROBOT = description.load("valve")
KNEE = ROBOT.joint("knee").model_copy(
    update={"actuator": ROBOT.joint("knee").actuator.model_copy(update=SMOOTH)}
)
MODEL = ActuatorModel.of(KNEE.actuator)
P = np.array(list(MODEL.parameters().values()))
DT = 1e-6


def plant():
    return Symbols([MODEL], DT).step()


def differences(at, direction):
    """d(state after a step)/d(state, current, dq) of the plant by differences to the side that the valve opens to."""
    step, rest = plant(), np.array(list(MODEL.rest(at).values()))
    scale = np.array([1e-6, 1e-3, 1.0, 1.0, 1e-9, 1e-7])

    def after(state, current=0.0, dq=0.0):
        return np.array(step(state, current, 24.0, at, dq, P)[0]).ravel()

    start = after(rest)
    columns = []
    for k, size in enumerate(scale):
        change = np.zeros(6)
        change[k] = direction * size
        columns.append((after(rest + change) - start) / (direction * size))
    current = (after(rest, direction * 1e-7) - start) / (direction * 1e-7)
    velocity = (after(rest, 0.0, direction * 1e-6) - start) / (direction * 1e-6)
    return np.column_stack(columns), current, velocity


@pytest.mark.parametrize("at", [-0.6, 0.0, 0.5])
def test_it_is_the_derivative_of_the_plant(at):
    system = hydraulics.state_space(KNEE, Inertia(inertia="0.3 kgm2", at=f"{at} rad"))
    exact = expm(system.a * DT)
    # an opening valve has the drop of one side or of the other: the model has the mean
    (forth, current, velocity), (back, *_) = differences(at, 1.0), differences(at, -1.0)
    size = np.array([1.0, 1e3, 1e7, 1e7, 1e-2, 1.0])  # of the states
    error = (0.5 * (forth + back) - exact[:6, :6]) * size[None, :] / size[:, None]
    rates = (exact[:6, :6] - np.eye(6)) * size[None, :] / size[:, None]
    assert np.abs(error).max() < 5e-3 * np.abs(rates).max()
    by_current = DT * system.b[:6, 0] * KNEE.actuator.torque_per_ampere
    np.testing.assert_allclose(current[1], by_current[1], rtol=1e-2)
    np.testing.assert_allclose(velocity[5], DT * system.a[5, 7], rtol=1e-2)  # the joint's end of the load cell moves


@pytest.mark.parametrize("at", [-0.6, 0.0, 0.5])
def test_natural_velocity_feedback_and_what_makes_up_for_it(at):
    """K_v: the piston's force falls by β (A₁²/V₁ + A₂²/V₂) per distance; k_vc: the opening that brings as much back."""
    actuator, step = KNEE.actuator, plant()
    rest = np.array(list(MODEL.rest(at).values()))
    areas = np.array([actuator.piston_area, -actuator.rod_area])

    def force_rate(spool=0.0, velocity=0.0):
        state = rest + np.array([spool, 0.0, 0.0, 0.0, 0.0, velocity])
        after = np.array(step(state, spool * actuator.current_limit, 24.0, at, 0.0, P)[0]).ravel()
        return areas @ (after - state)[2:4] / DT

    still, h = force_rate(), 1e-5
    lost = (force_rate(velocity=h) - force_rate(velocity=-h)) / (2 * h)
    gained = 0.5 * (force_rate(spool=h) - force_rate(spool=-h)) / h  # of both sides the mean
    of = hydraulics.chambers(KNEE, at)
    assert lost == pytest.approx(-of.velocity_feedback(actuator), rel=0.02)
    assert gained == pytest.approx(of.force_gain(actuator), rel=0.02)
    compensation = hydraulics.velocity_compensation(KNEE, at)  # A s/m
    moving = force_rate(spool=compensation * h / actuator.current_limit, velocity=h)
    back = force_rate(spool=-compensation * h / actuator.current_limit, velocity=-h)
    assert abs(moving - back) / 2 < 0.02 * abs(lost) * h
    assert np.isfinite(still)


def test_the_firmware_s_full_compensation_is_that_of_the_model_within_a_tenth():
    assert current_per_velocity(KNEE) / KNEE.actuator.nominal_arm == pytest.approx(
        hydraulics.velocity_compensation(KNEE, 0.0), rel=0.1
    )


def test_a_locked_joint_has_no_motion_and_a_pendulum_no_linear_model():
    assert hydraulics.state_space(KNEE, Locked()).a.shape == (6, 6)
    with pytest.raises(ValueError, match="not linear"):
        hydraulics.state_space(KNEE, Pendulum())
    with pytest.raises(ValueError, match="not hydraulic"):
        hydraulics.state_space(description.load("vlca").joint("ankle"), Locked())
