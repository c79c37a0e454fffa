"""The bank: parameters and supply while it runs, its state, and an actuator of one's own."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from plant.actuators.bank import ActuatorBank
from plant.actuators.model import ActuatorModel, NoModelError
from plant.bench import Bench, Locked
from plant.config import SensorConfig
from robots import description, pins
from robots.actuators import Actuator
from tests.plant.test_bench import Draw

HUME = description.load("hume")
OWN = Path(__file__).parents[3] / "docs" / "examples" / "geared_motor.toml"
DT = 1.0 / 3000.0


def bank(robot=HUME, friction=1.0, dt=DT):
    n = len(robot.joints)
    return ActuatorBank(robot, dt, friction, lambda f: f, np.zeros(n), np.zeros(n))


def run(actuators, steps, current=3.0):
    actuators.current[:] = current
    return np.array([actuators.step().copy() for _ in range(steps)])


def test_a_broken_spring_of_one_joint_transmits_nothing_and_the_others_do_not_notice():
    whole, broken = bank(), bank()
    broken.set(2, "stiffness", 0.0)
    broken.set(2, "damping", 0.0)
    expected, torque = run(whole, 300), run(broken, 300)
    assert not torque[:, 2].any()
    others = [0, 1, 3, 4, 5]
    assert (torque[:, others] == expected[:, others]).all() and expected[:, others].any()
    assert broken.get(2, "stiffness") == 0.0 and broken.get(1, "stiffness") == 360.0
    assert set(broken.parameters(2)) > {"stiffness", "damping", "coulomb", "resistance", "ambient"}
    with pytest.raises(KeyError):
        broken.set(2, "stifness", 0.0)


def test_more_friction_holds_a_rotor_that_ran_before():
    actuators = bank()
    actuators.set(0, "static", 100.0)
    run(actuators, 100, 3.0)
    velocity = actuators.observe().motor_velocity
    assert velocity[0] == 0.0 and (velocity[1:] != 0.0).all()


def test_a_supply_that_falls_holds_back_the_current_of_its_joint_only():
    actuators = bank()
    actuators.supply[3] = 0.5
    run(actuators, 1, 10.0)
    seen = actuators.observe()
    assert seen.supply.tolist() == [48.0, 48.0, 48.0, 0.5, 48.0, 48.0]
    assert 0 < seen.current[3] < 0.5 / HUME.joints[3].actuator.motor.resistance < 10.0
    assert (np.delete(seen.current, 3) == 10.0).all()


def test_a_restored_bank_goes_on_as_the_first_did_parameters_included():
    actuators = bank()
    run(actuators, 50)
    actuators.set(1, "viscous", 9.0)
    saved = actuators.snapshot()
    first = run(actuators, 50)
    actuators.set(1, "viscous", 0.0)
    actuators.supply[:] = 1.0
    run(actuators, 5, -3.0)
    actuators.restore(saved)
    assert (run(actuators, 50) == first).all()


def test_friction_scale_scales_what_the_model_calls_friction():
    rough, smooth = bank(friction=2.0), bank(friction=0.0)
    assert rough.get(0, "coulomb") == 2 * HUME.joints[0].actuator.coulomb
    assert smooth.get(0, "static") == 0.0
    assert rough.get(0, "viscous") == smooth.get(0, "viscous") > 0


def test_what_has_no_model_says_so():
    class Nothing(Actuator):
        kind: str = "nothing"

    with pytest.raises(NoModelError, match=r"no model of Nothing: .*describes=Nothing"):
        ActuatorModel.of(Nothing(current_limit=1.0))


# --- docs/examples/geared_motor.py ------------------------------------------------------------------------------


def test_an_actuator_of_one_s_own_is_named_in_the_description():
    a = description.load(str(OWN)).joints[0].actuator
    assert type(a).__name__ == "GearedMotor"
    assert a.torque_per_ampere == 50.0 * 0.04 and a.rotor_inertia == pytest.approx(0.025)


def test_the_geared_motor_crosses_its_play_before_it_pushes():
    robot = description.load(str(OWN))
    a, dt = robot.joints[0].actuator, 1e-4
    actuators = bank(robot, 0.0, dt)
    torque = run(actuators, 2000, 0.5)[:, 0]
    touched = int(np.flatnonzero(torque)[0])
    # until then a free rotor: play/2 = tau t² / (2 J)
    assert touched * dt == pytest.approx((a.play * a.rotor_inertia / (0.5 * a.torque_per_ampere)) ** 0.5, rel=0.1)

    def flow(_, z):
        pressed = z[0] - np.clip(z[0], -a.play / 2, a.play / 2)
        teeth = a.stiffness * pressed + (a.damping * z[1] if pressed else 0.0)
        return [z[1], (0.5 * a.torque_per_ampere - teeth - a.viscous * z[1]) / a.rotor_inertia]

    theta = solve_ivp(flow, (0.0, 0.2), [0.0, 0.0], rtol=1e-8, atol=1e-10, max_step=1e-3).y[0, -1]
    assert actuators.observe().motor[0] == pytest.approx(theta, rel=0.01)
    assert torque[-1] == pytest.approx(0.5 * a.torque_per_ampere, rel=0.05)


def test_the_geared_motor_works_on_the_bench_behind_the_pins():
    robot = description.load(str(OWN))
    bench = Bench(robot, 0, Locked(), 12000.0, SensorConfig(noise=0, bias=0), lambda _: Draw(), friction_scale=0.0)
    bench.pins_out[:] = round(2.0 / pins.AMPERE_PER_COUNT), 1
    bench.latch()
    for _ in range(24000):
        bench.step()
    bench.sample()
    a = robot.joints[0].actuator
    assert bench.spring_torque == pytest.approx(4.0, rel=1e-3)
    expected = robot.joints[0].sensor.encoder * (4.0 / a.stiffness + a.play / 2)
    assert bench.pins_in[pins.MOTOR_ENCODER] == pytest.approx(expected, abs=1)
    assert bench.pins_in[pins.CURRENT_ADC] == 200
