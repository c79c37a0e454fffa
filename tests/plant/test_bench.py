"""The bench against differential equations and conservation laws."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from plant.bench import LOADS, Inertia, Locked, Pendulum
from plant.bench import Bench as NoisyBench
from plant.config import SensorConfig
from robots import description, pins

HUME = description.load("hume")
RATE = 12000.0


class Draw:
    """A random stream whose state is its position."""

    at = 0

    def normal(self, n):
        self.at += n
        return np.sin(np.arange(self.at - n, self.at))

    def snapshot(self):
        return self.at

    def restore(self, at):
        self.at = at


def Bench(robot, index, load, rate, **sensors):
    """A bench, by default with perfect sensors."""
    return NoisyBench(robot, index, load, rate, SensorConfig(**{"noise": 0, "bias": 0, **sensors}), lambda _: Draw())


def smooth(joint="right_hip", **actuator):
    """Hume with one joint's dry friction (and what else is named) taken out."""
    dry = {"coulomb": 0.0, "static": 0.0, "load_friction": 0.0}
    index = HUME.joint_names.index(joint)
    changed = HUME.joints[index].model_copy(
        update={"actuator": HUME.joints[index].actuator.model_copy(update={**dry, **actuator})}
    )
    joints = tuple(changed if j.name == joint else j for j in HUME.joints)
    return HUME.model_copy(update={"joints": joints}), index


def demand(bench, amperes):
    bench.pins_out[pins.CURRENT_DEMAND] = round(amperes / pins.AMPERE_PER_COUNT)
    bench.pins_out[pins.ENABLE] = 1
    bench.latch()


@pytest.mark.parametrize("load", [
    Inertia(inertia="0.3kgm2", damping="0.8Nms/rad"), Pendulum(mass="2kg", length="0.5m", at="0.2rad"),
], ids=lambda load: type(load).__name__)  # fmt: skip
def test_a_driven_load_moves_as_its_differential_equation(load):
    robot, index = smooth()
    a = robot.joints[index].actuator
    bench = Bench(robot, index, load, RATE)
    demand(bench, 2.0)
    times = np.arange(6000) / RATE
    measured = []
    for _ in times:
        measured.append((bench.position, bench.velocity))
        bench.step()
    weight = load.mass * 9.81 * load.length if isinstance(load, Pendulum) else 0.0

    def flow(_, z):
        theta, dtheta, q, dq = z
        spring = a.stiffness * (theta - q) + a.damping * (dtheta - dq)
        motor = 2.0 * a.gear_ratio * a.torque_constant - spring - a.viscous * dtheta
        return [dtheta, motor / a.rotor_inertia, dq, (spring - load.damping * dq - weight * np.sin(q)) / load.inertia]

    start = [load.at, 0.0, load.at, 0.0]
    truth = solve_ivp(flow, (0.0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-12).y
    position, velocity = np.array(measured).T
    assert np.abs(position).max() > 0.1  # it moves
    assert np.abs(position - truth[2]).max() < 0.01 * np.abs(truth[2]).max()
    assert np.abs(velocity - truth[3]).max() < 0.02 * np.abs(truth[3]).max()


def test_a_flywheel_without_losses_keeps_the_momentum_that_the_motor_gave():
    robot, index = smooth(viscous=0.0)
    a, load = robot.joints[index].actuator, Inertia(inertia="0.3kgm2", damping=0)
    bench = Bench(robot, index, load, RATE)
    demand(bench, 1.0)
    for _ in range(1200):
        bench.step()
    bench.pins_out[pins.ENABLE] = 0
    bench.latch()
    for _ in range(5000):
        bench.step()
    momentum = a.rotor_inertia * bench.actuator.observe().motor_velocity[0] + load.inertia * bench.velocity
    assert momentum == pytest.approx(a.torque_per_ampere * 1200 / RATE, rel=1e-6)


def test_a_locked_output_stays_and_the_spring_carries_the_motors_torque():
    robot, index = smooth()
    bench = Bench(robot, index, Locked(at="0.3rad"), RATE)
    demand(bench, 1.5)
    for _ in range(20 * int(RATE)):
        bench.step()
    assert (bench.position, bench.velocity) == (0.3, 0.0)
    assert bench.spring_torque == pytest.approx(1.5 * robot.joints[index].actuator.torque_per_ampere, rel=1e-3)
    bench.sample()
    joint = robot.joints[index]
    deflection = bench.spring_torque / joint.actuator.stiffness
    assert bench.pins_in[pins.SPRING_ENCODER] == round(deflection * joint.spring_counts_per_rad)
    assert bench.pins_in[pins.MOTOR_ENCODER] == pytest.approx(deflection * joint.sensor.encoder, abs=1)


def test_a_pendulum_hangs_where_its_weight_equals_the_static_torque():
    robot, index = smooth(viscous=5.0)
    bench = Bench(robot, index, Pendulum(mass="4kg", length="0.5m", damping="5Nms/rad"), RATE)
    demand(bench, 1.0)
    for _ in range(10 * int(RATE)):
        bench.step()
    torque = robot.joints[index].actuator.torque_per_ampere
    assert np.sin(bench.position) == pytest.approx(torque / (4 * 9.81 * 0.5), rel=1e-3)


def test_currents_saturate_and_a_disabled_stage_gives_none():
    bench = Bench(HUME, 1, Locked(), RATE)
    limit = HUME.joints[1].actuator.current_limit
    for amperes, enable, expected in ((1e3, 1, limit), (-1e3, 1, -limit), (1e3, 0, 0.0)):
        bench.pins_out[:] = round(amperes / pins.AMPERE_PER_COUNT), enable
        bench.latch()
        bench.step()
        bench.sample()
        assert bench.pins_in[pins.CURRENT_ADC] == round(expected / pins.AMPERE_PER_COUNT)


def test_a_load_too_light_for_the_step_is_refused_and_the_lightest_is_stable():
    robot, index = smooth(damping=0.0, viscous=0.0)
    with pytest.raises(ValueError, match=r"expected at least 0\.00016 kg m²") as refused:
        Bench(robot, index, Inertia(inertia="1e-6kgm2"), 3000.0)
    assert "360 N m/rad at 3000 steps per second" in str(refused.value)
    bench = Bench(robot, index, Inertia(inertia="0.00017kgm2", damping=0), 3000.0)
    demand(bench, 0.5)
    for _ in range(3000):
        bench.step()
        assert abs(bench.spring_torque) < 10


@pytest.mark.parametrize("kind", LOADS)
def test_a_restored_bench_goes_on_as_the_first_did(kind):
    bench = Bench(HUME, 2, LOADS[kind](), 3000.0, noise=1, bias=1)

    def go_on():
        rows = []
        for k in range(300):
            bench.pins_out[:] = 300 - k, 1
            bench.latch()
            bench.step()
            bench.sample()
            rows.append((bench.position, bench.spring_torque, *bench.pins_in))
        return rows

    go_on()
    saved = bench.snapshot()
    first = go_on()
    bench.restore(saved)
    assert go_on() == first


def test_the_lightest_load_is_stable_on_a_stiff_damped_spring_too():
    vlca = description.load("vlca")
    with pytest.raises(ValueError, match=r"expected at least 0\.025 kg m²"):
        Bench(vlca, 0, Inertia(inertia="0.02kgm2"), 3000.0)
    bench = Bench(vlca, 0, Inertia(inertia="0.026kgm2", damping=0), 3000.0)
    demand(bench, 1.0)
    for _ in range(1000):
        bench.step()
        assert abs(bench.spring_torque) < 10
