"""The delay margin that the emulation shows, against theory."""

import pytest

from hil.joint_lab import analysis, chirp
from hil.joint_lab.bisection import delay_margin, grows


def kick(setup):
    return 0.2 * chirp.amplitude(setup, 50.0)


@pytest.mark.parametrize("law", ["PD_f", "PD_m", "PID_m", "PD_m+DOB", "cascade"])
def test_delay_margins_agree_within_an_interrupt(experiment, law):
    setup = experiment("vlca", "ankle", law)
    margins = analysis.as_sampled(setup).margins
    found = delay_margin(setup, kick(setup), margins.critical.omega, margins.delay_margin, 0.25 * setup.period)
    assert found == pytest.approx(margins.delay_margin, abs=setup.period)


def test_a_hydraulic_joint_s_delay_margin_agrees_within_an_interrupt(experiment):
    setup = experiment("valve", "knee", "valve")
    margins = analysis.as_sampled(setup).margins
    found = delay_margin(setup, kick(setup), margins.critical.omega, margins.delay_margin, 0.25 * setup.period)
    assert found == pytest.approx(margins.delay_margin, abs=setup.period)


def test_oscillations_grow_beyond_the_margin_and_die_away_before_it(experiment):
    setup = experiment("hume", "left_knee")
    margins = analysis.as_sampled(setup).margins
    omega = margins.critical.omega
    assert not grows(setup, kick(setup), omega)
    assert not grows(setup.delayed(margins.delay_margin - setup.period), kick(setup), omega)
    assert grows(setup.delayed(margins.delay_margin + setup.period), kick(setup), omega)
    assert grows(setup.delayed(4 * margins.delay_margin), kick(setup), omega)  # up to where limits hold it


def test_a_loop_that_is_unstable_by_itself_has_no_margin(experiment):
    setup = experiment("hume", "left_knee", settings=["firmware.stance.kp=60", "firmware.stance.kd=0 N m s/rad"])
    assert not analysis.as_sampled(setup).stable
    with pytest.raises(ValueError, match="unstable without"):
        delay_margin(setup, kick(experiment("hume", "left_knee")), 300.0, 1e-3, 1e-4)
