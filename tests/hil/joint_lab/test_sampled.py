"""The sampled loop against a fine simulation of held inputs, hand-derived transfer functions and python-control."""

import math

import control
import numpy as np
import pytest
from scipy.linalg import expm

from hil.joint_lab.actuator import LinearActuator, StateSpace, state_space
from hil.joint_lab.sampled import (
    SampledLaw,
    at_reports,
    closed_loop,
    discretise,
    open_loop,
    response,
    spectral_radius,
)

SEA = LinearActuator(inertia=0.09, viscous=1.5, stiffness=450.0, damping=0.2, torque_per_ampere=6.0)
LOADED = SEA._replace(load=0.4, load_damping=0.5)
PERIOD = 1 / 3000
KP, KD = 4.0, 10.0


def proportional_derivative(kp=KP, kd=KD, period=PERIOD):
    """tau_m = tau_d + kp (tau_d − k deflection) − kd (theta − theta before) / T; a state for theta before."""
    k = SEA.stiffness
    return SampledLaw(
        StateSpace(
            np.zeros((1, 1)), np.array([[1.0, 0.0, 0.0]]), np.array([[kd / period]]),
            np.array([[-kd / period, -kp * k, 1 + kp]]),
        ),
        period,
    )  # fmt: skip


def simulate(actuator, demands, delay, steps=60):
    """Samples of (theta, deflection) by exact steps of a 60th of the period, demands held from ``delay`` on."""
    model = state_space(actuator)
    n = len(model.a)
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n], augmented[:n, n:] = model.a, model.b
    step = expm(augmented * PERIOD / steps)
    x, samples = np.zeros(n), []
    for k in range(len(demands) * steps):
        if k % steps == 0:
            samples.append(model.c @ x)
        index = math.floor(k / steps - delay / PERIOD + 1e-9)
        held = demands[index] if index >= 0 else 0.0
        x = (step @ np.append(x, held))[:n]
    return np.array(samples)


@pytest.mark.parametrize("actuator", [SEA, LOADED], ids=["clamped", "loaded"])
@pytest.mark.parametrize("lag", [0.0, 0.4, 1.0, 1.25, 3.0, 3.75])
def test_a_delayed_hold_is_exact_at_the_samples(actuator, lag):
    demands = np.random.default_rng(1).normal(size=12)
    plant = discretise(state_space(actuator), PERIOD, lag * PERIOD).system
    x, found = np.zeros(len(plant.a)), []
    for demand in demands:
        found.append(plant.c @ x)
        x = plant.a @ x + plant.b[:, 0] * demand
    expected = simulate(actuator, demands, lag * PERIOD)
    np.testing.assert_allclose(np.array(found)[:, :2], expected, atol=1e-12)
    acted = [demands[k - math.floor(lag + 1e-9) - 1] if k > lag else 0.0 for k in range(len(demands))]
    np.testing.assert_array_equal(np.array(found)[:, 2], acted)  # read before a new demand takes effect


def test_a_loop_is_the_product_of_the_hand_derived_transfer_functions():
    omega = np.geomspace(1.0, 9000.0, 50)
    z = np.exp(1j * omega * PERIOD)
    plant = discretise(state_space(LOADED), PERIOD, PERIOD)
    undelayed = response(discretise(state_space(LOADED), PERIOD, 0.0).system, z)
    theta, deflection = undelayed[:, 0, 0] / z, undelayed[:, 1, 0] / z
    by_hand = KP * SEA.stiffness * deflection + KD * (1 - 1 / z) / PERIOD * theta
    np.testing.assert_allclose(open_loop(plant, proportional_derivative(), omega), by_hand, rtol=1e-9)


def test_closed_loop_is_that_of_python_control():
    plant, law = discretise(state_space(LOADED), PERIOD, PERIOD), proportional_derivative()
    p = control.ss(*plant.system, dt=PERIOD)
    w = control.ss(*law.system, dt=PERIOD)
    names = {"inputs": ["u"], "outputs": ["theta", "deflection", "current"]}
    p = control.ss(p, name="plant", **names)
    w = control.ss(w, name="law", inputs=["theta", "deflection", "command"], outputs=["u"])
    whole = control.interconnect([p, w], inputs=["command"], outputs=["theta", "deflection", "current", "u"])
    ours = closed_loop(plant, law)
    for z in np.exp(1j * np.array([0.01, 0.1, 1.0, 3.0])):
        np.testing.assert_allclose(response(ours, np.array([z]))[0], whole(z).reshape(4, 1), rtol=1e-8, atol=1e-12)


def test_closed_loop_oscillates_for_ever_at_its_delay_margin():
    """Nyquist's crossovers against the eigenvalues of the loop with the delay in it, between samples, too."""
    from hil.joint_lab.margins import margins

    law, model = proportional_derivative(), state_space(SEA)
    plant = discretise(model, PERIOD, PERIOD)
    assert spectral_radius(plant, law) < 1
    margin = margins(lambda w: open_loop(plant, law, w), 1.0, 0.999 * math.pi / PERIOD).delay_margin
    assert 0.5 * PERIOD < margin < 100 * PERIOD

    def radius(delay):
        return spectral_radius(discretise(model, PERIOD, PERIOD + delay), law)

    assert radius(margin - 0.02 * PERIOD) < 1 < radius(margin + 0.02 * PERIOD)


@pytest.mark.parametrize(("ratio", "offset"), [(1, 0), (2, 0), (2, 1), (3, 2)])
def test_what_a_bus_sees_is_every_so_many_samples_of_held_commands(ratio, offset):
    system = closed_loop(discretise(state_space(LOADED), PERIOD, PERIOD), proportional_derivative())
    seen = at_reports(system, ratio, offset)
    commands = np.random.default_rng(2).normal(size=15)
    x, reports = np.zeros(len(system.a)), []
    for tick in range(ratio * len(commands)):
        number = (tick - offset) // ratio
        u = commands[number] if number >= 0 else 0.0
        if tick % ratio == 0:
            reports.append(system.c @ x + system.d[:, 0] * u)
        x = system.a @ x + system.b[:, 0] * u
    x, found = np.zeros(len(seen.a)), []
    for u in commands:
        found.append(seen.c @ x + seen.d[:, 0] * u)
        x = seen.a @ x + seen.b[:, 0] * u
    np.testing.assert_allclose(found, reports, atol=1e-9)
