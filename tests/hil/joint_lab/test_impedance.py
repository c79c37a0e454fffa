"""Output impedance against a time simulation of a moved output, and passivity against known cases."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from hil.joint_lab.actuator import LinearActuator, StateSpace
from hil.joint_lab.continuous import Gains
from hil.joint_lab.impedance import continuous, passivity, sampled
from hil.joint_lab.margins import frequencies
from hil.joint_lab.sampled import SampledLaw
from joint_firmware.config import TorqueGains
from joint_firmware.laws.cascade import not_passive
from robots import description

SEA = LinearActuator(inertia=0.09, viscous=1.5, stiffness=450.0, damping=0.2, torque_per_ampere=6.0)
OMEGA = frequencies(0.1, 2e3)


@pytest.mark.parametrize("hertz", [0.7, 5.0, 20.0])
def test_impedance_is_what_a_shaken_output_feels(hertz):
    gains = Gains(kp=3.0, kd=10.0)
    w = 2 * math.pi * hertz

    def spring(t, x):
        return SEA.stiffness * (x[0] - math.sin(w * t)) + SEA.damping * (x[1] - w * math.cos(w * t))

    def motion(t, x):
        sensed = SEA.stiffness * (x[0] - math.sin(w * t))
        motor = -gains.kp * sensed - gains.kd * x[1]
        return x[1], (motor - SEA.viscous * x[1] - spring(t, x)) / SEA.inertia

    periods = 8
    t = np.linspace(0, periods / hertz, 400 * periods + 1)[:-1] + 2.0
    x = solve_ivp(motion, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-9, atol=1e-12).y
    torque = np.array([spring(*sample) for sample in zip(t, x.T, strict=True)])
    velocity = w * np.cos(w * t)
    wave = np.exp(-1j * w * t)
    expected = -(torque @ wave) / (velocity @ wave)
    assert continuous("PD_m", SEA, gains, np.array([w]))[0] == pytest.approx(expected, rel=1e-5)


def test_without_control_the_actuator_is_passive_and_behaves_as_rotor_and_spring():
    z = continuous("PD_m", SEA, Gains(), OMEGA)
    assert passivity(OMEGA, z).passive
    slow = continuous("PD_m", SEA, Gains(), np.array([1e-3]))[0]
    assert slow == pytest.approx(SEA.viscous + 1e-3j * SEA.inertia, rel=1e-3)  # the spring moves along


def test_integrating_torque_is_passive_only_below_a_bound():
    """Slowly moved, the output feels Z ≈ s (J s + B) / ((1 + kp) s + ki), B = b + kd: Re Z has the sign of
    (1 + kp) B − ki J."""
    rigid = SEA._replace(damping=0.0)
    kp, kd = 3.0, 10.0
    bound = (1 + kp) * (rigid.viscous + kd) / rigid.inertia
    low = frequencies(1e-3, 1.0)
    assert passivity(low, continuous("PID_m", rigid, Gains(kp=kp, ki=0.9 * bound, kd=kd), low)).passive
    found = passivity(low, continuous("PID_m", rigid, Gains(kp=kp, ki=1.1 * bound, kd=kd), low))
    assert not found.passive and found.worst is not None and found.worst < 0
    assert found.from_hz is not None and found.worst_hz is not None and found.from_hz <= found.worst_hz


@settings(max_examples=60)
@given(kp=st.floats(0.2, 30.0), ki=st.floats(0.0, 400.0), kd=st.floats(1.0, 60.0), w_i=st.floats(0.5, 300.0))
def test_the_cascade_is_passive_where_its_own_criterion_says_so(kp, ki, kd, w_i):
    """The criterion of ``joint_firmware.laws.cascade`` was derived from the admittance, without the spring's losses."""
    joint = description.load("hume").joint("left_knee")
    a = joint.actuator
    gains = TorqueGains(kp=kp, ki=ki, kd=f"{kd!r} N m s/rad")
    # clear of the boundaries, where a grid of frequencies cannot tell
    low, high = w_i * kp * kd / a.viscous, (1 + kp) * (a.viscous + kd) / a.rotor_inertia
    assume(abs(ki / low - 1) > 0.1 and abs((ki + w_i * kp) / high - 1) > 0.1)
    rigid = LinearActuator(a.rotor_inertia, a.viscous, a.stiffness, 0.0, a.torque_per_ampere)
    omega = frequencies(1e-3, 1e5)
    z = continuous("cascade", rigid, Gains(kp=kp, ki=ki, kd=kd, velocity_integral=w_i), omega)
    assert passivity(omega, z).passive == (not not_passive(joint, gains, w_i))


def test_a_fast_sampled_law_has_the_impedance_of_the_continuous_one():
    period, kp, kd, k = 1e-6, 3.0, 10.0, SEA.stiffness
    law = SampledLaw(
        StateSpace(np.zeros((1, 1)), np.array([[1.0, 0, 0]]), np.array([[kd / period]]),
                   np.array([[-kd / period, -kp * k, 1 + kp]])),
        period,
    )  # fmt: skip
    expected = continuous("PD_m", SEA, Gains(kp=kp, kd=kd), OMEGA)
    np.testing.assert_allclose(sampled(law, SEA, period, OMEGA), expected, rtol=0.01)


def test_delay_makes_a_torque_loop_active():
    period, kp, k = 1 / 3000, 3.0, SEA.stiffness
    law = SampledLaw(StateSpace(np.zeros((1, 1)), np.zeros((1, 3)), np.zeros((1, 1)),
                                np.array([[0.0, -kp * k, 1 + kp]])), period)  # fmt: skip
    assert passivity(OMEGA, sampled(law, SEA, 0.0, OMEGA)).passive
    assert not passivity(OMEGA, sampled(law, SEA, 5e-3, OMEGA)).passive
