"""Velocity estimators: their resolution against Ohmae et al. 1982, delays, standstill."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.velocity import ESTIMATORS, estimator_function
from tests.joint_firmware.laws.rig import DT, Drive

STEP = 1e-4  # rad per count


def estimate(method, positions, **config):
    """Velocity of every tick from ``positions`` [rad], which an encoder of STEP has quantised."""
    estimator, step = ESTIMATORS[method]("motor"), estimator_function(method)
    values = estimator.settings(FirmwareConfig(**config))
    parameters = [values[name] for name in estimator.parameters]
    state, trace = np.zeros(len(estimator.states)), []
    for n, position in enumerate(positions):
        state, out = step(STEP * math.floor(position / STEP), float(n > 0), STEP, state, parameters)
        trace.append(float(out))
    return np.array(trace)


def at(velocity, seconds=1.0, phase=0.3):
    return velocity * DT * np.arange(round(seconds / DT)) + phase * STEP


velocities = st.floats(1e-3, 20.0).flatmap(lambda v: st.sampled_from([v, -v]))


@given(velocities, st.integers(1, 20), st.floats(0, 1))
def test_m_is_within_one_count_per_gate(velocity, ticks, phase):
    got = estimate("M", at(velocity, 0.1, phase), velocity_window=f"{ticks * DT!r} s")[2 * ticks :]
    resolution = STEP / (ticks * DT)
    assert np.abs(got - velocity).max() <= resolution * (1 + 1e-6)
    counts = got / resolution
    assert counts == pytest.approx(np.rint(counts), abs=1e-6)  # nothing between: that is the method's resolution


def periods(velocity):
    """Ticks between two counts."""
    return STEP / (abs(velocity) * DT)


@given(st.floats(1.5, 200.0), st.sampled_from([1, -1]), st.floats(0, 1))
def test_t_is_within_one_tick_per_count(ticks, sign, phase):
    """Ohmae: the error of T is one clock in the time between edges; here the clock is the interrupt's."""
    velocity = sign * STEP / (ticks * DT)
    got = estimate("T", at(velocity, (8 * ticks + 10) * DT, phase))[round(3 * ticks) + 2 :]
    shortest, longest = max(math.ceil(ticks) - 1, 1), math.floor(ticks) + 1
    bounds = sorted((STEP / (shortest * DT), STEP / (longest * DT)))
    assert (np.abs(got) >= bounds[0] * (1 - 1e-9)).all() and (np.abs(got) <= bounds[1] * (1 + 1e-9)).all()
    assert (np.sign(got) == sign).all()


@given(velocities, st.integers(2, 30), st.floats(0, 1))
def test_m_t_is_within_one_tick_per_gate(velocity, gate, phase):
    """Its gate is at least the configured one and ends with an edge: the time of its counts is known to a tick."""
    settle = 2 * gate + 3 * periods(velocity) + 5
    got = estimate("M/T", at(velocity, (settle + 200) * DT, phase), velocity_window=f"{gate * DT!r} s")[round(settle) :]
    time = max(gate, math.floor(periods(velocity)))
    assert np.abs(got / velocity - 1).max() <= 1 / max(time - 1, 1e-9) + 1e-9


def test_edges_tell_more_than_counts_while_there_is_less_than_one_per_tick():
    slow, fast = (
        {method: estimate(method, at(v, 3.0))[3000:].std() for method in ESTIMATORS} for v in (0.02 + 1e-5, 2.0 + 1e-3)
    )
    assert max(slow["T"], slow["M/T"]) < 0.1 * min(slow["M"], slow["filter"])
    # beyond, the interrupt's clock sees an edge in every tick: M/T is M, T the bare difference of two ticks
    assert fast["M/T"] == fast["M"] < 0.5 * fast["T"]


@pytest.mark.parametrize("method", ["T", "M/T"])
def test_without_edges_the_velocity_falls_as_one_count_over_the_time_since_the_last(method):
    positions = np.concatenate([at(1.0, 0.05), np.full(3000, 0.05)])
    got = estimate(method, positions)
    since = np.arange(100, 3000)
    assert (got[150 + since] <= 2.2 * STEP / (since * DT)).all() and got[-1] > 0


@pytest.mark.parametrize("method", ESTIMATORS)
def test_an_encoder_that_stands_still_gives_exactly_nothing_from_the_start(method):
    assert not estimate(method, np.full(100, 0.7)).any()


@pytest.mark.parametrize("method, delay", [("M", 2e-3), ("M/T", 2e-3), ("filter", 1 / (2 * math.pi * 200.0))])
def test_delay(method, delay):
    """Under constant acceleration the estimate lags by half the gate and, held for one, on average by another half."""
    t = DT * np.arange(3000)
    got = estimate(method, 0.5 * 20.0 * t**2)[1500:]
    lag = np.mean(t[1500:] - got / 20.0)
    assert lag == pytest.approx(delay, abs=1.1 * DT)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_every_estimator_runs_in_a_drive(method):
    drive = Drive(velocity_estimator=method)
    for n in range(300):
        drive(np.rint(drive.counts(phi=2.0 * n * DT, effort=60.0 * n * DT)), drive.command("none"))
    assert drive.state("motor_velocity") == pytest.approx(2.0, rel=0.05)
    assert drive.y[1] * 1e-5 == pytest.approx(2.0 - 60.0 / drive.joint.actuator.stiffness, rel=0.1)
