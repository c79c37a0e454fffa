"""Waves that were put in come out."""

import numpy as np
import pytest

from hil.analysis.damped_waves import damped_waves

T = np.arange(300) * 2e-3
SUM = 3.0 * np.exp(-2.0 * T) * np.cos(2 * np.pi * 17.0 * T + 0.4) + np.exp(1.5 * T) * np.sin(2 * np.pi * 5.0 * T)


def test_two_waves():
    first, second = damped_waves(SUM, 2e-3, order=10)[:2]
    assert first == pytest.approx((17.0, -2.0, 3.0), rel=1e-6)
    assert second == pytest.approx((5.0, 1.5, 1.0), rel=1e-6)


def test_two_waves_in_noise():
    noisy = SUM + 0.01 * np.random.default_rng(1).normal(size=len(T))
    first, second = damped_waves(noisy, 2e-3, order=10)[:2]
    assert first == pytest.approx((17.0, -2.0, 3.0), rel=0.02)
    assert second == pytest.approx((5.0, 1.5, 1.0), rel=0.05)


def test_what_does_not_oscillate():
    wave = damped_waves(np.exp(-4.0 * T), 2e-3, order=5)[0]
    assert wave == pytest.approx((0.0, -4.0, 1.0), abs=1e-6)


def test_too_few_values():
    with pytest.raises(ValueError, match="20 values: expected more than 60"):
        damped_waves(np.ones(20), 1e-3)
