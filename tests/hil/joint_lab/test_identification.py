"""Frequency responses of a known filter; sweeps and what belongs to them."""

import numpy as np
import pytest
from scipy.signal import butter, freqz, lfilter

from hil.joint_lab.excitation import SIZES, Sweeps
from hil.joint_lab.identification import frequency_response

RATE = 1500.0
SWEEPS = Sweeps(0.8, 230.0, 4.0, 2.0)


def swept(function):
    """Response of ``function`` between 1 Hz and 200 Hz, measured as an experiment is."""
    u = SWEEPS.samples(RATE)
    y = function(u)
    period, half = SWEEPS.period(RATE), round(0.5 * SWEEPS.rest * RATE)
    window = slice(half, half + len(SIZES) * period)
    return frequency_response(u[window], y[window], RATE, period, 1.0, 200.0)


def test_a_linear_filter_is_found_exactly_and_is_coherent():
    b, a = butter(2, 40.0, fs=RATE)
    found = swept(lambda u: lfilter(b, a, u))
    assert found.coherence.min() > 0.999
    _, exact = freqz(b, a, found.fine / (2 * np.pi), fs=RATE)
    np.testing.assert_allclose(found.values, found.averaged(exact), rtol=2e-4, atol=1e-6)


def test_averaging_over_bands_keeps_constants_and_leaves_no_frequency_out():
    found = swept(lambda u: u)
    np.testing.assert_allclose(found.averaged(np.ones(len(found.fine))), 1.0)
    assert found.omega[0] >= 2 * np.pi * 1.0 and found.omega[-1] <= 2 * np.pi * 200.0
    assert np.all(np.diff(found.omega) > 0)
    assert np.diff(np.log2(found.omega)).max() < 0.3  # where bands are wider than the resolution: a 24th


def test_noise_costs_coherence():
    noise = np.random.default_rng(5).normal(size=len(SWEEPS.samples(RATE)))
    assert swept(lambda u: u + 0.05 * noise).coherence.min() > 0.9
    assert np.median(swept(lambda u: u + 10 * noise).coherence) < 0.5


def test_what_does_not_grow_with_the_signal_costs_coherence():
    """A dead band, which the smaller sweeps do not leave as far as the larger ones."""
    found = swept(lambda u: np.sign(u) * np.maximum(np.abs(u) - 1.1, 0.0))
    assert np.median(found.coherence) < 0.95
    assert np.median(swept(lambda u: u).coherence) > 0.999


def test_sweeps_rest_between_and_keep_their_sizes():
    u = SWEEPS.samples(RATE)
    period, rest = SWEEPS.period(RATE), round(SWEEPS.rest * RATE)
    assert len(u) == len(SIZES) * period + rest
    for n, size in enumerate(SIZES):
        part = u[n * period : (n + 1) * period]
        assert not part[:rest].any()
        assert np.abs(part).max() == pytest.approx(abs(size) * SWEEPS.amplitude, rel=0.01)
        np.testing.assert_allclose(part, size * u[:period])
