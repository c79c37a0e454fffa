"""The second-order filter against scipy's bilinear transform of its transfer functions."""

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from joint_firmware.laws.filters import LowPass, half_step


def run(cutoff, dt, values):
    """Low-pass, rate and acceleration of a sequence."""
    x, value = ca.SX.sym("x", 2), ca.SX.sym("value")
    out = LowPass(x[0], x[1], cutoff, half_step(cutoff, dt)).filter(value)
    step = ca.Function("step", [x, value], [ca.vertcat(*out.next), ca.vertcat(out.low, out.rate, out.acceleration)])
    state, rows = np.zeros(2), []
    for v in values:
        state, row = (np.array(part).ravel() for part in step(state, v))
        rows.append(row)
    return np.array(rows).T


@given(st.floats(0.5, 1400.0), st.sampled_from([1e-3, 1 / 3000, 2e-4]), st.integers(0, 2**32 - 1))
def test_the_three_outputs_are_tustin_s_of_their_transfer_functions(hertz, dt, seed):
    hertz = min(hertz, 0.45 / dt)
    w = 2 * math.pi * hertz
    values = np.random.default_rng(seed).normal(size=60)
    got = run(w, dt, values)
    a = [1.0, math.sqrt(2.0) * w, w * w]
    warped = w / math.tan(0.5 * w * dt)  # s = warped (z − 1)/(z + 1)
    for order, out in enumerate(got):
        b = [w * w, *[0.0] * order]
        zb, za = signal.bilinear(b, a, 0.5 * warped)
        expected = signal.lfilter(zb, za, values)
        assert out == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max() + 1e-12)


def test_at_its_cutoff_the_response_is_the_continuous_one_s():
    dt, w = 1e-3, 2 * math.pi * 200.0
    n = np.arange(4000)
    low, rate, _ = run(w, dt, np.sin(w * dt * n))
    phasor = np.exp(-1j * w * dt * n[2000:]) @ np.column_stack([low, rate])[2000:] * 2j / 2000
    assert abs(phasor[0]) == pytest.approx(math.sqrt(0.5), rel=1e-3)
    assert np.angle(phasor[0], deg=True) == pytest.approx(-90.0, abs=0.1)
    assert phasor[1] == pytest.approx(1j * w * phasor[0], rel=1e-3)


def test_a_cutoff_beyond_half_the_rate_is_refused():
    with pytest.raises(ValueError, match="cutoff of 1500 Hz: expected less than half of the rate of 3000 Hz"):
        half_step(2 * math.pi * 1500.0, 1 / 3000)
