"""The hydraulic joint against textbook answers and a stiff solver."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from plant.actuators.bank import Symbols
from plant.actuators.hydraulic import LAMINAR_DROP, HydraulicModel
from plant.actuators.model import ActuatorModel
from robots import description

KNEE = description.load("valve").joint("knee").actuator
NAMES = list(ActuatorModel.of(KNEE).rest(0.0))
P_S, P_T, A_1, A_2 = KNEE.supply_pressure, KNEE.return_pressure, KNEE.piston_area, KNEE.rod_area
ORIFICE = KNEE.valve_flow / np.sqrt(KNEE.valve_drop)  # m³/s/√Pa fully open
IDEAL = {"coulomb": 0.0, "static": 0.0, "viscous_friction": 0.0, "leakage": 0.0, "valve_leakage": 0.0,
         "valve_offset": 0.0}  # fmt: skip


class Joint:
    """The actuator alone; the caller moves the joint."""

    def __init__(self, dt, q=0.0, **change):
        self.actuator = KNEE.model_copy(update=change)
        self.model = ActuatorModel.of(self.actuator)
        self._step = Symbols([self.model], dt).step()
        self.state = np.array(list(self.model.rest(q).values()))
        self._p = np.array(list(self.model.parameters().values()))

    def __getattr__(self, name):
        return self.state[NAMES.index(name)]

    def step(self, current, q=0.0, dq=0.0):
        """Torque on the joint, N m."""
        state, torque = self._step(self.state, current, self.actuator.supply_voltage, q, dq, self._p)
        self.state = np.array(state).ravel()
        return float(torque)


def on_an_inertia(dt, duration, current, inertia=0.13, **change):
    """Joint angle and speed, torque and pressures [MPa] at the end, with ``current(t)`` [A]."""
    joint, q, dq, torque = Joint(dt, **change), 0.0, 0.0, 0.0
    for k in range(round(duration / dt)):
        torque = joint.step(current((k + 0.5) * dt), q, dq)
        dq += dt * torque / inertia
        q += dt * dq
    return np.array([q, dq, 1e-6 * joint.cap, 1e-6 * joint.rod, joint.piston])


def by_a_stiff_solver(duration, current, inertia=0.13):
    """The equations once more, in continuous time, for an actuator without dry friction."""
    a, linkage = KNEE, KNEE.linkage
    omega = 2 * np.pi * a.valve_bandwidth

    def length(q):
        c, b = linkage.crank, linkage.base
        return np.sqrt(c * c + b * b - 2 * c * b * np.cos(q + linkage.offset))

    def orifice(drop):
        return ORIFICE * drop / np.sqrt(abs(drop) + LAMINAR_DROP)

    def rate(t, s):
        u, du, p1, p2, x, v, q, dq = s
        joint = length(q)
        arm = linkage.crank * linkage.base * np.sin(q + linkage.offset) / joint
        force = a.cell_stiffness * (x - (joint - length(0.0))) + a.cell_damping * (v - arm * dq)
        into_1 = u * (orifice(P_S - p1) if u > 0 else -orifice(P_T - p1))
        into_2 = -u * (-orifice(P_T - p2) if u > 0 else orifice(P_S - p2))
        into_1 += a.valve_leakage * (P_S + P_T - 2 * p1) + a.leakage * (p2 - p1)
        into_2 += a.valve_leakage * (P_S + P_T - 2 * p2) + a.leakage * (p1 - p2)
        return [
            du,
            omega**2 * (current(t) / a.current_limit - u) - 2 * a.valve_damping * omega * du,
            a.bulk_modulus / (a.dead_volume + A_1 * (a.stroke / 2 + x)) * (into_1 - A_1 * v),
            a.bulk_modulus / (a.dead_volume + A_2 * (a.stroke / 2 - x)) * (into_2 + A_2 * v),
            v,
            (p1 * A_1 - p2 * A_2 - force - a.viscous_friction * v) / a.piston_mass,
            dq,
            force * arm / inertia,
        ]

    start = [*ActuatorModel.of(KNEE).rest(0.0).values(), 0.0, 0.0]
    end = solve_ivp(rate, (0.0, duration), start, "Radau", rtol=1e-9, atol=1e-12).y[:, -1]
    return np.array([end[6], end[7], 1e-6 * end[2], 1e-6 * end[3], end[4]])


def _swing(t):
    return 1e-3 * np.sin(2 * np.pi * 15 * t)


def test_converges_to_a_stiff_solver_at_first_order():
    exact = by_a_stiff_solver(0.1, _swing)
    ideal = {"coulomb": 0.0, "static": 0.0, "valve_offset": 0.0}
    bench, coarse, fine = (on_an_inertia(dt, 0.1, _swing, **ideal) - exact for dt in (2e-4, 2e-5, 1e-5))
    assert coarse / fine == pytest.approx(2.0, rel=0.01)
    assert np.abs(bench / exact).max() < 0.025  # at the interrupt rate of a drive on board, 5 kHz


@settings(max_examples=30, deadline=None)
@given(st.sampled_from((1 / 3000, 1 / 5000, 1e-4)), st.floats(-1.0, 0.9), st.integers(0, 2**32 - 1))
def test_nothing_that_valve_and_joint_may_do_makes_it_diverge(dt, q, seed):
    rng = np.random.default_rng(seed)
    joint, dq = Joint(dt, q), 0.0
    for k in range(200):
        if k % 10 == 0:
            current, dq = 0.02 * rng.uniform(-1, 1), 12.0 * rng.uniform(-1, 1)
        if not -1.0 < q + dt * dq < 0.9:
            dq = -dq
        joint.step(current, q, dq)
        q += dt * dq
    assert np.isfinite(joint.state).all()
    assert 0.0 <= joint.cap < 2e8
    assert 0.0 <= joint.rod < 2e8
    assert abs(joint.spool) <= 1.0


@given(
    st.floats(-1, 1).filter(lambda u: abs(u) > 1e-3),
    st.floats(0.0, 30e6).filter(lambda p: min(abs(p - P_S), abs(p - P_T)) > 1e3),
)
def test_an_edge_lets_oil_through_in_the_direction_of_its_pressure_drop(spool, pressure):
    model = HydraulicModel(KNEE.model_copy(update=IDEAL))
    p = ca.DM  # parameters are plain numbers here
    flows = model.flows(p(spool), p(pressure), p(pressure), _namespace(model))
    cap_drop, rod_drop = (P_S - pressure, P_T - pressure) if spool > 0 else (P_T - pressure, P_S - pressure)
    for flow, drop in ((float(flows.cap), cap_drop), (float(flows.rod), rod_drop)):
        assert np.sign(flow) == np.sign(drop)
        assert abs(flow) <= abs(spool) * ORIFICE * np.sqrt(abs(drop))  # laminar below the root of large drops
        if abs(drop) > 10 * LAMINAR_DROP:
            assert abs(flow) == pytest.approx(abs(spool) * ORIFICE * np.sqrt(abs(drop)), rel=0.06)


def _namespace(model):
    from types import SimpleNamespace

    return SimpleNamespace(**model.parameters())


def test_the_valve_within_its_overlap_lets_nothing_through():
    model = HydraulicModel(KNEE.model_copy(update=IDEAL | {"valve_deadband": 1e-3}))
    for spool, opens in ((0.099, False), (-0.099, False), (0.11, True)):
        flows = model.flows(ca.DM(spool), ca.DM(5e6), ca.DM(5e6), _namespace(model))
        assert (float(flows.cap) != 0) is opens


@pytest.mark.parametrize(("current", "force"), [(0.01, P_S * A_1 - P_T * A_2), (-0.01, P_T * A_1 - P_S * A_2)])
def test_a_stalled_piston_pushes_with_the_supply_and_pulls_with_the_annulus(current, force):
    joint = Joint(1e-4, **IDEAL)
    for _ in range(1000):
        torque = joint.step(current)
    assert torque == pytest.approx(force * KNEE.nominal_arm, rel=1e-4)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_an_unloaded_piston_moves_as_fast_as_the_orifices_allow(share):
    """Both edges in series: v = k u √((A₁ p_s − A₂ p_t) / (A₁³ + A₂³)), Merritt 1967 §6.5 for unequal areas."""
    speed = ORIFICE * share * np.sqrt((A_1 * P_S - A_2 * P_T) / (A_1**3 + A_2**3))
    dt, linkage = 1e-4, KNEE.linkage
    x = -0.025
    joint = Joint(dt, float(linkage.joint_angle(x / KNEE.nominal_arm)), **IDEAL)
    torques = []
    while x < 0.0:
        q = float(linkage.joint_angle(x / KNEE.nominal_arm))
        torques.append(joint.step(share * KNEE.current_limit, q, speed / float(linkage.arm(q))))
        x += dt * speed
    stalled = P_S * A_1 * KNEE.nominal_arm
    assert abs(torques[-1]) < 0.03 * stalled  # laminar flow at 2 % of the drop takes some


def test_a_closed_valve_makes_a_spring_of_the_oil():
    joint = Joint(1e-5, **IDEAL)
    before = joint.step(0.0)
    q = 1e-3
    dq = q / 2e-3
    for k in range(200):
        joint.step(0.0, k * 1e-5 * dq, dq)
    for _ in range(2000):
        after = joint.step(0.0, q)
    cell = KNEE.cell_stiffness * KNEE.nominal_arm**2
    series = 1 / (1 / KNEE.stiffness + 1 / cell)  # ``stiffness``: of the oil at mid-stroke
    assert (after - before) / -q == pytest.approx(series, rel=0.02)


def test_the_spool_lags_by_a_quarter_at_its_bandwidth_and_is_limited_in_rate():
    dt, f = 1e-5, KNEE.valve_bandwidth
    joint = Joint(dt, valve_offset=0.0)
    spool = []
    for k in range(round(0.04 / dt)):
        joint.step(1e-4 * np.sin(2 * np.pi * f * k * dt))
        spool.append(joint.spool)
    t = dt * np.arange(1, len(spool) + 1)[-round(5 / f / dt) :]
    phasor = np.mean(np.array(spool)[-len(t) :] * np.exp(-2j * np.pi * f * t))
    assert np.degrees(np.angle(phasor * 1j)) == pytest.approx(-90, abs=2)
    assert 2 * abs(phasor) == pytest.approx(0.01 / (2 * KNEE.valve_damping), rel=0.03)

    joint = Joint(dt, valve_offset=0.0, valve_slew=100.0)
    for _ in range(500):
        joint.step(KNEE.current_limit)
    assert joint.spool == pytest.approx(0.5, abs=0.05)  # 5 ms at 100 openings per second, less the start


def test_seals_hold_the_piston_until_the_oil_has_built_up_their_static_friction():
    joint = Joint(1e-4, leakage=0.0, valve_leakage=0.0, valve_offset=0.0)
    pushing = [0.0]
    while joint.velocity == 0:
        joint.step(2e-5)
        pushing.append(joint.cap * A_1 - joint.rod * A_2)
    assert pushing[-2] == pytest.approx(KNEE.static, abs=pushing[-1] - pushing[-2])
    assert len(pushing) > 10


def test_a_valve_off_its_zero_moves_nothing_at_the_current_of_its_offset():
    torques = []
    for current in (0.0, 2e-4):
        joint = Joint(1e-4, **IDEAL | {"valve_offset": 2e-4})
        for _ in range(200):
            torque = joint.step(current)
        torques.append(torque)
    assert torques[1] == 0.0
    assert torques[0] < -10.0
