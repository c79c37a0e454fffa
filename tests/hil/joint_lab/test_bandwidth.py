"""Bandwidths against closed forms."""

import math

import numpy as np
import pytest

from hil.joint_lab.bandwidth import bandwidth, torque_bandwidth
from hil.joint_lab.setup import Setup, Timing
from hil.lab.quantity import changed
from hil.scenario import Scenario, load
from plant.bench import Locked
from robots import description


@pytest.mark.parametrize("damping", [0.2, 0.7, 1.5])
def test_of_a_second_order_low_pass(damping: float) -> None:
    natural = 50.0

    def closed(omega: np.ndarray) -> np.ndarray:
        s = 1j * omega
        return natural**2 / (s**2 + 2.0 * damping * natural * s + natural**2)

    a = 1.0 - 2.0 * damping**2
    expected = natural * math.sqrt(a + math.sqrt(a * a + 1.0))
    assert bandwidth(closed, 0.01, 1e4) == pytest.approx(expected, rel=1e-6)
    assert bandwidth(closed, 0.01, 0.9 * expected) is None


def _setup(scenario: Scenario, rate: float) -> Setup:
    robot = description.load(scenario.robot)
    firmware = scenario.firmware.model_copy(update={"rate": rate, "report_rate": rate})
    joint = robot.joint_names.index("left_knee")
    return Setup(robot, joint, firmware, Locked(), scenario.sensors, Timing(rate, rate))


@pytest.mark.parametrize("factor", [0.25, 1.0, 4.0])
def test_of_a_torque_loop_sampled_fast_is_that_of_its_differential_equation(factor: float) -> None:
    scenario = changed(load("stand"), {"joint.torque_feedback": factor})
    setup = _setup(scenario, 1e5)
    actuator, gains = setup.actuator(), setup.firmware.stance
    cutoff = 2.0 * math.pi * setup.firmware.velocity_cutoff

    def closed(omega: np.ndarray) -> np.ndarray:
        s = 1j * omega
        rotor = actuator.inertia * s**2 + (actuator.viscous + actuator.damping) * s + actuator.stiffness
        fed_back = gains.kp * actuator.stiffness + gains.kd * s * cutoff / (s + cutoff)
        return (1.0 + gains.kp) * actuator.stiffness / (rotor + fed_back)

    expected = bandwidth(closed, 0.01, 1e4)
    assert expected is not None
    assert torque_bandwidth(setup) == pytest.approx(expected / (2.0 * math.pi), rel=0.01)


def test_an_unstable_torque_loop_has_none() -> None:
    assert torque_bandwidth(_setup(changed(load("stand"), {"joint.torque_feedback": 1e4}), 3e3)) is None
