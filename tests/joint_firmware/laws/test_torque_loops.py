"""Each torque loop against a difference equation in plain floats, written from its source."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from joint_firmware.config import LAW_NAMES, FirmwareConfig, canonical_law
from joint_firmware.laws import TORQUE_LOOPS
from joint_firmware.laws.cascade import not_passive, stable
from joint_firmware.laws.valve import current_per_velocity
from robots.actuators import Hydraulic
from tests.joint_firmware.laws.rig import ANKLE, DT, HIP, KNEE, Held, LoopAlone

CONFIG = FirmwareConfig()
seeds = st.integers(0, 2**32 - 1)
gain_sets = st.fixed_dictionaries({
    "kp": st.floats(0, 10), "ki": st.one_of(st.just(0.0), st.floats(1.0, 300.0)), "kd": st.floats(0, 50),
})  # fmt: skip


def integral_gains(high):
    return st.one_of(st.just(0.0), st.floats(0.1, high))


def walk(seed, ticks=80):
    """Reference, torque and motor velocity of every tick."""
    rng = np.random.default_rng(seed)
    return np.column_stack([40 * rng.normal(size=(ticks, 2)), 3 * rng.normal(size=ticks)])


def tustin(b, a, w):
    """Discrete b, a of a transfer function, prewarped at w."""
    return signal.bilinear(b, a, 0.5 * w / math.tan(0.5 * w * DT))


def integral(errors, gain):
    """What has been integrated before each tick."""
    return gain * DT * np.concatenate([[0.0], np.cumsum(errors)[:-1]])


def test_the_catalogue_has_what_the_configuration_names():
    assert set(TORQUE_LOOPS) == set(LAW_NAMES)


@pytest.mark.parametrize(
    "text, name", [("PDm+DOB", "PD_m+DOB"), ("pid m", "PID_m"), ("Cascade", "cascade"), ("PD_F", "PD_f")]
)
def test_a_law_s_name_is_read_whatever_its_case_underscores_and_spaces(text, name):
    assert canonical_law(text) == name and FirmwareConfig(law=text).law == name


def test_an_unknown_law_is_refused():
    with pytest.raises(ValueError, match="'PD_f', 'PD_m', 'PID_m', 'PD_m\\+DOB', 'cascade' or 'valve'"):
        FirmwareConfig(law="LQR")


@given(seeds, gain_sets)
def test_pd_m_and_pid_m(seed, gains):
    rows = walk(seed)
    errors = rows[:, 0] - rows[:, 1]
    expected = rows[:, 0] + gains["kp"] * errors - gains["kd"] * rows[:, 2]
    for name, more in (("PD_m", 0.0), ("PID_m", integral(errors, gains["ki"]))):
        loop = LoopAlone(name)
        assert [loop(r, t, v, **gains) for r, t, v in rows] == pytest.approx(list(expected + more), rel=1e-9, abs=1e-9)


@given(seeds, gain_sets, st.floats(5.0, 500.0))
def test_pd_f(seed, gains, cutoff):
    rows = walk(seed)
    w = 2 * math.pi * cutoff
    zb, za = tustin([1.0, 0.0], [1 / w**2, math.sqrt(2) / w, 1.0], w)  # (5.13)
    rate = signal.lfilter(zb, za, rows[:, 1])
    errors = rows[:, 0] - rows[:, 1]
    expected = rows[:, 0] + gains["kp"] * errors - gains["kd"] / HIP.actuator.stiffness * rate  # (5.12)
    loop = LoopAlone("PD_f", config=FirmwareConfig(torque_rate_cutoff=f"{cutoff} Hz"))
    got = [loop(r, t, v, **gains) for r, t, v in rows]
    assert got == pytest.approx(list(expected), rel=1e-7, abs=1e-7 * np.abs(expected).max())


@given(seeds, gain_sets, st.floats(5.0, 200.0), st.sampled_from([HIP, ANKLE]))
def test_the_disturbance_observer(seed, gains, cutoff, joint):
    """(5.19): (1 − Q) r = tau_d − Q P_c⁻¹ tau, with both transfer functions whole, discretised by scipy."""
    rows = walk(seed)
    a, w = joint.actuator, 2 * math.pi * cutoff
    kp, kd = gains["kp"], gains["kd"]
    q = [1.0, math.sqrt(2) * w, w * w]
    stiff = a.stiffness * (1 + kp)
    inverse = np.array([a.rotor_inertia, a.viscous + a.damping + kd, stiff]) / stiff  # (5.18)
    observed = signal.lfilter(*tustin(w * w * inverse, q, w), rows[:, 1])
    zb, za = tustin([w * w], q, w)
    r = signal.lfilter(za, np.array(za) - np.array(zb), rows[:, 0] - observed)
    expected = r + kp * (r - rows[:, 1]) - kd * rows[:, 2]
    loop = LoopAlone("PD_m+DOB", joint, FirmwareConfig(observer_cutoff=f"{cutoff} Hz"))
    got = [loop(*row, **gains) for row in rows]
    assert got == pytest.approx(list(expected), rel=1e-6, abs=1e-6 * np.abs(expected).max())


@given(seeds, st.floats(0.1, 5), st.floats(0.0, 50), st.floats(1.0, 50), st.floats(0.5, 100))
def test_the_cascade_is_the_source_s_pair_of_pi_loops(seed, p_t, i_t, p_v, i_v):
    """In the gains of the source: of torque to velocity (P_t, I_t), of velocity to torque (P_v, I_v)."""
    rows = walk(seed)
    errors = rows[:, 0] - rows[:, 1]
    velocity_errors = p_t * errors + integral(errors, i_t) - rows[:, 2]
    expected = p_v * velocity_errors + integral(velocity_errors, i_v)
    loop = LoopAlone("cascade", config=FirmwareConfig(velocity_integral=i_v / p_v))
    got = [loop(*row, kp=p_v * p_t, ki=p_v * i_t, kd=p_v) for row in rows]
    assert got == pytest.approx(list(expected), rel=1e-7, abs=1e-7 * np.abs(expected).max())


@given(seeds, gain_sets, st.floats(0, 1), st.floats(-2e-3, 2e-3))
def test_the_valve_s_law(seed, gains, share, bias):
    rows = walk(seed)
    w = 2 * math.pi * 60.0
    rate = signal.lfilter(*tustin([1.0, 0.0], [1 / w**2, math.sqrt(2) / w, 1.0], w), rows[:, 1])
    errors = rows[:, 0] - rows[:, 1]
    k_vc = share * current_per_velocity(KNEE)
    per_ampere = KNEE.actuator.torque_per_ampere
    expected = gains["kp"] * errors + integral(errors, gains["ki"]) - gains["kd"] / KNEE.actuator.stiffness * rate
    expected += per_ampere * (k_vc * rows[:, 2] + bias)
    config = FirmwareConfig(law="valve", velocity_compensation=share, valve_bias=f"{bias!r} A")
    loop = LoopAlone("valve", KNEE, config)
    got = [loop(*row, **gains) for row in rows]
    assert got == pytest.approx(list(expected), rel=1e-7, abs=1e-7 * np.abs(expected).max())


def test_velocity_compensation_gives_the_moving_piston_its_flow():
    """At the current that it adds, the valve's orifice equation lets through what the piston sweeps."""
    a = KNEE.actuator
    assert isinstance(a, Hydraulic)
    velocity = 0.7  # rad/s
    share_of_rated = current_per_velocity(KNEE) * velocity / a.current_limit
    drop = (a.supply_pressure - a.return_pressure) / 2
    flow = share_of_rated * a.valve_flow * math.sqrt(drop / a.valve_drop)
    assert flow == pytest.approx((a.piston_area + a.rod_area) / 2 * a.nominal_arm * velocity)
    assert current_per_velocity(HIP) == 0.0


# --- what the loops achieve on an actuator whose output is held ------------------------------------------------------


def settle(name, reference=20.0, disturbance=0.0, seconds=3.0, joint=HIP, config=CONFIG, **gains):
    """The torque of every tick, with ``disturbance`` [N m] added to the motor's effort."""
    loop, held, trace = LoopAlone(name, joint, config), Held(joint), []
    for _ in range(round(seconds / DT)):
        effort = loop(reference, held.torque, held.motor_velocity, **gains)
        held.step(effort + disturbance)
        trace.append(held.torque)
    return np.array(trace)


@pytest.mark.parametrize("joint", [HIP, ANKLE], ids=lambda j: j.name)
@pytest.mark.parametrize("name", ["PD_f", "PD_m"])
def test_without_an_integral_a_disturbance_is_divided_by_one_plus_kp(name, joint):
    kd = 0.1 * joint.actuator.stiffness * DT * 30
    trace = settle(name, 20.0, -8.0, joint=joint, kp=3.0, kd=kd)
    assert trace[-1] == pytest.approx(20.0 - 8.0 / 4.0, abs=1e-3)


@pytest.mark.parametrize(
    "name, gains",
    [("PID_m", {"kp": 3.0, "ki": 20.0}), ("PD_m+DOB", {"kp": 3.0}), ("cascade", {"kp": 3.0}),
     ("cascade", {"kp": 3.0, "ki": 20.0})],
)  # fmt: skip
def test_an_integral_or_the_observer_rejects_a_constant_disturbance(name, gains):
    assert settle(name, 20.0, -8.0, **gains)[-1] == pytest.approx(20.0, abs=1e-3)


def test_without_a_disturbance_the_observer_leaves_pd_m_s_response_as_it_is():
    """Kim 2018 Fig. 5.12: "DOB theoretically does not change the transfer function"; up to one sample's delay."""
    plain, observed = settle("PD_m", seconds=0.5), settle("PD_m+DOB", seconds=0.5)
    assert np.abs(observed - plain).max() < 0.05 * plain.max()


# --- passivity of the cascade ---------------------------------------------------------------------------------------


def admittance(joint, gains, wi, w):
    """−dq/tau of the actuator at tau_d = 0, from its own equations: motor, PI, PI, spring."""
    a, s = joint.actuator, 1j * w
    p_v, i_v = gains.kd, wi * gains.kd
    p_t, i_t = gains.kp / gains.kd, gains.ki / gains.kd
    velocity, torque = p_v + i_v / s, p_t + i_t / s
    return s / a.stiffness + (1 + velocity * torque) / (a.rotor_inertia * s + a.viscous + velocity)


@given(st.floats(0.1, 30), integral_gains(3000), st.floats(0.5, 60), integral_gains(500))
def test_the_passivity_conditions_are_those_of_the_real_part(kp, ki, kd, wi):
    gains = CONFIG.stance.model_copy(update={"kp": kp, "ki": ki, "kd": kd})
    w = np.logspace(-4, 7, 4000)
    real = admittance(HIP, gains, wi, w).real
    b, inertia = HIP.actuator.viscous, HIP.actuator.rotor_inertia
    margins = (wi * (wi * kp * kd - ki * b), (1 + kp) * (b + kd) - inertia * (ki + wi * kp))
    if all(abs(margin) > 1e-3 for margin in margins):  # a frequency grid cannot tell the edge
        assert (not not_passive(HIP, gains, wi)) == bool((real >= -1e-12).all())


@given(st.floats(0.1, 30), integral_gains(3000), st.floats(0.5, 60), integral_gains(500))
def test_a_passive_cascade_is_stable_with_its_output_held(kp, ki, kd, wi):
    gains = CONFIG.stance.model_copy(update={"kp": kp, "ki": ki, "kd": kd})
    if not not_passive(HIP, gains, wi):
        assert stable(HIP, gains, wi)


def test_stability_is_told_as_the_motion_shows_it():
    """Near the edge of stability, slow enough that sampling does not matter."""
    for ki, expected in ((300.0, True), (700.0, False)):
        gains = CONFIG.stance.model_copy(update={"kp": 3.0, "ki": ki, "kd": 10.0})
        assert stable(HIP, gains, 0.0) is expected
        config = FirmwareConfig(velocity_integral=0.0)
        trace = settle("cascade", 1.0, seconds=1.0, config=config, kp=3.0, ki=ki, kd=10.0)
        assert bool(np.abs(trace[-300:] - 1.0).max() < 0.1) is expected


def test_gains_that_are_not_passive_are_told_and_unstable_ones_refused():
    loop, swing = TORQUE_LOOPS["cascade"], {"kp": 3.0, "ki": 520.0, "kd": "10 N m s/rad"}
    assert loop.doubts(HIP, CONFIG) == []
    high, low = sorted(loop.doubts(HIP, FirmwareConfig(swing=swing, velocity_integral=2.0)))
    assert high.startswith("right_hip, firmware.swing: the cascade is not passive at high frequencies: ki + ")
    assert "ki = 520 1/s, expected at most 41.67 1/s" in low
    with pytest.raises(ValueError, match=r"right_hip, firmware\.swing: the cascade with kp = 3, ki = 6000 1/s, .*"):
        loop.doubts(HIP, FirmwareConfig(swing={**swing, "ki": 6000.0}))
