"""Series elastic actuators against analytic answers and an independent model."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.actuators import motor
from plant.actuators.bank import ActuatorBank, Symbols
from plant.actuators.model import ActuatorModel
from robots import description

HIP = description.load("hume").joint("right_hip").actuator
DT = 1.0 / 3000.0


def stepper(dt):
    """``(rotor, current, joint, p) -> (next, torque)`` of one actuator, its supply on, its winding cold."""
    function = Symbols([ActuatorModel.of(HIP)], dt).step()

    def step(rotor, current, joint, p):
        state = [*rotor, *motor.rest().values()]
        after, torque = function(state, current, HIP.supply_voltage, joint[0], joint[1], p)
        return np.array(after).ravel()[:2], torque

    return step


STEP = stepper(DT)
NAMES = list(ActuatorModel.of(HIP).parameters())


def parameters(**change):
    return np.array(list(ActuatorModel.of(HIP.model_copy(update=change)).parameters().values()))


FRICTIONLESS = {"coulomb": 0.0, "static": 0.0, "load_friction": 0.0, "viscous": 0.0}


def run(p, rotor, current=0.0, joint=(0.0, 0.0), steps=1, step=STEP):
    rows = [np.array(rotor, float)]
    for _ in range(steps):
        rows.append(np.array(step(rows[-1], current, joint, p)[0]).ravel())
    return np.array(rows)


def test_free_oscillation_has_the_frequency_of_rotor_and_spring():
    theta = run(parameters(damping=0.0, **FRICTIONLESS), (0.1, 0.0), steps=6000)[:, 0]
    rising = np.flatnonzero((theta[:-1] < 0) & (theta[1:] >= 0))
    times = (rising - theta[rising] / (theta[rising + 1] - theta[rising])) * DT
    omega = 2 * np.pi * (len(times) - 1) / (times[-1] - times[0])
    assert omega == pytest.approx(np.sqrt(HIP.stiffness / HIP.rotor_inertia), rel=1e-4)
    assert np.abs(theta[-300:]).max() == pytest.approx(0.1, rel=0.02)  # it neither gains nor loses energy


def test_a_rotor_at_rest_stays_exactly_there_below_breakaway_and_moves_above():
    p = parameters()
    breakaway = HIP.static / HIP.torque_per_ampere  # A; relaxed spring
    held = run(p, (0.3, 0.0), 0.999 * breakaway, (0.3, 0.0), 500)
    assert (held == [0.3, 0.0]).all()
    assert run(p, (0.3, 0.0), 1.001 * breakaway, (0.3, 0.0), 1)[-1, 1] > 0
    assert run(p, (0.3, 0.0), -1.001 * breakaway, (0.3, 0.0), 1)[-1, 1] < 0


def test_transmitted_torque_adds_to_breakaway():
    deflection = 0.05
    spring = HIP.stiffness * deflection
    level = HIP.static + HIP.load_friction * spring
    for excess, moves in ((-0.01, False), (0.01, True)):
        current = (spring + level + excess) / HIP.torque_per_ampere
        assert bool(run(parameters(), (deflection, 0.0), current)[-1, 1] != 0) is moves


def test_a_coasting_rotor_stops_after_the_time_and_the_way_of_dry_friction():
    p = parameters(damping=0.0, viscous=0.0, static=HIP.coulomb)
    p[NAMES.index("stiffness")] = 0.0  # no spring
    rows = run(p, (0.0, 2.0), steps=300)
    deceleration = HIP.coulomb / HIP.rotor_inertia
    stopped = int(np.flatnonzero(rows[:, 1] == 0.0)[0])
    assert stopped * DT == pytest.approx(2.0 / deceleration, abs=DT)
    assert rows[-1, 0] == pytest.approx(2.0**2 / (2 * deceleration), abs=2.0 * DT)
    assert (rows[stopped:, 1] == 0.0).all() and (rows[:, 1] >= 0.0).all()


@given(st.floats(-5, 5), st.floats(-0.3, 0.3), st.floats(-40, 40))
def test_dry_friction_only_ever_takes_speed_away(dtheta, deflection, current):
    with_friction = run(parameters(viscous=0.0), (deflection, dtheta), current)[-1, 1]
    without = run(parameters(**FRICTIONLESS), (deflection, dtheta), current)[-1, 1]
    assert with_friction * without >= 0.0
    assert abs(with_friction) <= abs(without)


def test_current_saturates():
    p = parameters(**FRICTIONLESS)
    assert (run(p, (0.0, 0.0), 1e3) == run(p, (0.0, 0.0), HIP.current_limit)).all()


def _reference(dt, duration, current):
    """Motor and load as two hinges coupled by a tendon with stiffness and damping."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = dt, mujoco.mjtIntegrator.mjINT_RK4
    spec.option.gravity = np.zeros(3)
    for name, inertia in (("motor", HIP.rotor_inertia), ("load", 0.3)):
        body = spec.worldbody.add_body(name=name, mass=1.0, inertia=[inertia] * 3, explicitinertial=True)
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    tendon = spec.add_tendon(name="spring")
    tendon.stiffness[0], tendon.damping[0] = HIP.stiffness, HIP.damping
    tendon.springlength = [0.0, 0.0]
    tendon.wrap_joint("motor", 1.0)
    tendon.wrap_joint("load", -1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(round(duration / dt)):
        data.qfrc_applied[0] = HIP.torque_per_ampere * current - HIP.viscous * data.qvel[0]
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


def _ours(dt, duration, current):
    step = stepper(dt)
    p = parameters(coulomb=0.0, static=0.0, load_friction=0.0)
    rotor, q, dq = np.zeros(2), 0.0, 0.0
    for _ in range(round(duration / dt)):
        rotor, torque = (np.array(x).ravel() for x in step(rotor, current, (q, dq), p))
        dq += dt * torque[0] / 0.3
        q += dt * dq
    return np.array([rotor[0], q, rotor[1], dq])


def test_agrees_with_two_hinges_and_a_tendon_at_first_order():
    reference = _reference(1e-5, 0.2, 3.0)
    coarse, fine = (np.abs(_ours(dt, 0.2, 3.0) - reference).max() for dt in (2e-4, 1e-4))
    assert fine < 2e-3 * np.abs(reference).max()
    assert coarse / fine == pytest.approx(2.0, rel=0.1)


def test_all_actuators_at_once_are_each_alone():
    robot = description.load("hume")
    rng = np.random.default_rng(3)
    q, dq = rng.normal(size=6), rng.normal(size=6)
    together = ActuatorBank(robot, DT, 1.0, lambda f: f, q, dq)
    start = together.state.copy()
    together.current[:] = 10.0 * rng.normal(size=6)
    q += 0.1
    torque = together.step().copy()
    for i, joint in enumerate(robot.joints):
        model = ActuatorModel.of(joint.actuator)
        own = list(together.symbols.state_index[i].values())
        after, alone = Symbols([model], DT).step()(
            start[own], together.current[i], joint.actuator.supply_voltage, q[i], dq[i],
            np.array(list(model.parameters().values())),
        )  # fmt: skip
        assert float(alone) == torque[i]
        assert np.array(after).ravel().tolist() == together.state[own].tolist()
