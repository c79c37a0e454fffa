"""The whole way of a measured frequency response: bus, log, identification, against theory and the source's order."""

import math

import pytest

from bus.messages import Mode
from hil.joint_lab import analysis, chirp
from hil.joint_lab.excitation import Sweeps
from plant.bench import Inertia

LAWS = ["PD_m", "PD_m+DOB", "PID_m", "PD_f"]  # by the phase margins of Kim 2018 Fig. 5.10


def sweeps(setup, low=8.0, high=120.0, rest=0.3):
    return Sweeps(low, high, 1.0, chirp.amplitude(setup, high), rest)


def test_measured_torque_is_the_predicted_one_and_margins_are_in_the_source_s_order(experiment):
    margins = []
    for law in LAWS:
        setup = experiment("vlca", "ankle", law)
        found = chirp.run(setup, sweeps(setup))
        assert found.torque.coherent.all() and found.limited == 0
        assert found.torque.magnitude_deviation < 0.10
        assert math.degrees(found.torque.phase_deviation) < 2.0
        (crossover,) = found.crossovers
        predicted = analysis.as_sampled(setup).margins.critical
        assert predicted is not None
        assert math.degrees(crossover.phase_margin - predicted.phase_margin) == pytest.approx(0, abs=1.0)
        assert crossover.omega == pytest.approx(predicted.omega, rel=0.02)
        margins.append(crossover.phase_margin)
    assert margins == sorted(margins, reverse=True)


@pytest.mark.parametrize(("robot", "joint"), [("hume", "left_knee"), ("vlca", "ankle")])
def test_without_a_torque_loop_and_with_a_load(experiment, robot, joint):
    setup = experiment(robot, joint, load=Inertia(inertia="0.4 kgm2", damping="2 Nms/rad", at="0.3rad"))
    for mode in (Mode.TORQUE, Mode.OPEN_LOOP):
        moded = setup._replace(mode=mode)
        found = chirp.run(moded, sweeps(moded, high=30.0, rest=1.0))
        assert found.torque.coherent.all()
        assert found.torque.magnitude_deviation < 0.06
        assert math.degrees(found.torque.phase_deviation) < 4.0


def test_dry_friction_parts_measurement_and_theory(experiment):
    """The comparison can fail: theory knows nothing of friction."""
    setup = experiment("hume", "left_knee", friction_scale=1.0)
    found = chirp.run(setup, sweeps(setup, high=60.0))
    assert found.torque.magnitude_deviation > 0.1


def test_a_wrong_delay_in_theory_is_seen(experiment, tmp_path):
    setup = experiment("vlca", "ankle")
    signal = sweeps(setup)
    chirp.run(setup, signal, directory=tmp_path)
    assumed = setup.delayed(0.25 * setup.period)
    found = chirp.evaluate(assumed, signal, tmp_path / f"{setup.bus}.log")
    assert math.degrees(found.torque.phase_deviation) > 2.0
