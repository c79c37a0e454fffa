"""Open loops in continuous time against the source's table, its equations with delay, and python-control."""

import math

import control
import numpy as np
import pytest

from hil.joint_lab.actuator import LinearActuator, responses, state_space
from hil.joint_lab.continuous import Gains, low_pass, open_loop
from hil.joint_lab.margins import margins

# Kim 2018 Table 5.1 and §5.3.2, per metre of screw travel: N_m = 3316 rad/m
I_M, B_M, M_R, B_R, K_R = 3.5e-5, 2.0e-4, 1.3, 2.0e4, 5.5e6
N_M, N = 3316.0, 0.9 * 0.0448 * 3316.0
VLCA = LinearActuator(I_M * N_M**2 + M_R, B_M * N_M**2, K_R, B_R, N)
GAINS = Gains(kp=4.0, ki=300.0, kd=15.0 * N_M, derivative_cutoff=60.0, observer_cutoff=15.0)
PRINTED = {"PD_m": 47.6, "PD_m+DOB": 42.8, "PID_m": 34.0, "PD_f": 17.7}  # degrees, Fig. 5.10


def loop(law, actuator=VLCA, gains=GAINS):
    rational = open_loop(law, actuator, gains)
    return lambda omega: rational(1j * omega)


def found(law, actuator=VLCA, gains=GAINS):
    return margins(loop(law, actuator, gains), 0.1, 1e5)


@pytest.mark.parametrize("law", PRINTED)
def test_phase_margins_are_those_of_figure_5_10(law):
    assert math.degrees(found(law).phase_margin) == pytest.approx(PRINTED[law], abs=1.5)


def test_phase_margins_are_in_the_order_of_figure_5_10():
    assert sorted(PRINTED, key=lambda law: -found(law).phase_margin) == list(PRINTED)


@pytest.mark.parametrize("load", [math.inf, 1500.0, 40.0])
def test_responses_are_those_of_the_state_space(load):
    actuator = VLCA._replace(load=load, load_damping=0.0 if math.isinf(load) else 300.0)
    plant, model = responses(actuator), state_space(actuator)
    s = 1j * np.geomspace(1.0, 1e4, 30)
    for n, value in enumerate(s):
        theta, deflection = (model.c @ np.linalg.solve(value * np.eye(len(model.a)) - model.a, model.b)).ravel()
        assert plant.deflection(value) / plant.denominator(value) == pytest.approx(deflection, rel=1e-9), n
        assert plant.velocity(value) / plant.denominator(value) == pytest.approx(value * theta, rel=1e-9), n


def test_response_to_motor_torque_is_5_9():
    """As printed, in screw coordinates, with the rubber between the chassis and the ground."""
    load = 2000.0
    s = 1j * np.geomspace(1.0, 1e4, 30)
    p_m, p_r, p_l = 1 / (I_M * s**2 + B_M * s), 1 / (M_R * s**2 + B_R * s + K_R), 1 / (load * s**2)
    printed = p_m * p_r / N_M / (p_m / N_M**2 + p_l + p_r)
    # m_r counts with the rotor here; the source has it on the other side of the rubber: 0.3 % of the inertia
    plant = responses(VLCA._replace(load=load))
    ours = N_M * plant.deflection(s) / plant.denominator(s)
    assert np.abs(ours / printed - 1).max() < 0.02


@pytest.mark.parametrize("law", ["PD_f", "PD_m", "PID_m", "PD_m+DOB"])
def test_with_a_delay_the_loops_are_those_of_5_12_to_5_20(law):
    """F_k / F_r solved from the printed equations, with T in them, against 1 / (1 + e^(−Ts) L) times what drives it."""
    delay, s = 1e-3, 1j * np.geomspace(1.0, 2e3, 40)
    p_x = N / ((I_M * N_M**2 + M_R) * s**2 + (B_M * N_M**2 + B_R) * s + K_R)  # (5.11)
    e, plant, kp, ki, kdm = np.exp(-delay * s), K_R * p_x / N, 4.0, 300.0, 15.0
    if law == "PD_f":
        w = 2 * math.pi * 60.0
        q_d = s / ((s / w) ** 2 + 1.414 * (s / w) + 1)  # (5.13)
        feedback, forward = kp + kdm * N_M / K_R * q_d, kp + 1  # (5.12)
    elif law == "PD_m":
        feedback, forward = kp + kdm * s * N_M / K_R, kp + 1
    elif law == "PID_m":
        feedback, forward = kp + ki / s + kdm * s * N_M / K_R, kp + ki / s + 1  # (5.16)
    else:
        q = 1 / low_pass(15.0)(s)
        p_c = K_R * p_x * (kp + 1) / (N + p_x * (K_R * kp + kdm * s * N_M))  # (5.18)
        inner = plant * (kp + 1) / (1 + e * plant * (kp + kdm * s * N_M / K_R))
        closed = inner / (1 - q) / (1 + inner * e * q / p_c / (1 - q))  # (5.19) solved for F_k / F_d
        driven = plant * (kp + 1) / (1 - q)
        np.testing.assert_allclose(closed, driven / (1 + e * loop(law)(s / 1j)), rtol=1e-9)
        return
    closed = plant * forward / (1 + e * plant * feedback)
    np.testing.assert_allclose(closed, plant * forward / (1 + e * loop(law)(s / 1j)), rtol=1e-9)


@pytest.mark.parametrize("law", ["PD_f", "PD_m", "PID_m", "PD_m+DOB", "cascade"])
@pytest.mark.parametrize("load", [math.inf, 300.0])
def test_margins_are_those_of_python_control(law, load):
    gains = GAINS if law != "cascade" else GAINS._replace(ki=3.0, velocity_integral=5.0)
    actuator = VLCA._replace(load=load, load_damping=0.0 if math.isinf(load) else 2e3)
    rational = open_loop(law, actuator, gains)
    system = control.tf(rational.numerator.coef[::-1], rational.denominator.coef[::-1])
    gain, phase, _, _, at, _ = control.stability_margins(system)
    ours = margins(lambda omega: rational(1j * omega), 0.01, 1e5)
    assert ours.critical is not None
    assert math.degrees(ours.phase_margin) == pytest.approx(phase, abs=0.01)
    assert ours.critical.omega == pytest.approx(at, rel=1e-4)
    if math.isfinite(gain):
        assert ours.gain_margin == pytest.approx(gain, rel=1e-3)
