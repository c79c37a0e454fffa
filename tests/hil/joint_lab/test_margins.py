"""Margins against loops whose margins are known."""

import math

import numpy as np
import pytest

from hil.joint_lab.margins import margins


def test_an_integrator_with_delay_has_the_margins_of_the_textbook():
    """k e^(−Ts)/s crosses over at k; its phase is −π at ω = π/(2T); it may be delayed by π/(2k) in all."""
    k, delay = 10.0, 0.05
    found = margins(lambda w: k * np.exp(-1j * w * delay) / (1j * w), 0.01, 100.0)
    assert found.critical is not None and found.critical.omega == pytest.approx(k)
    assert found.phase_margin == pytest.approx(math.pi / 2 - k * delay)
    assert found.delay_margin == pytest.approx(math.pi / (2 * k) - delay)
    assert found.gain_margin == pytest.approx(math.pi / (2 * delay) / k)


def test_of_several_crossovers_the_smallest_margin_counts_even_if_another_has_the_smaller_phase_margin():
    """A loop with a resonance beyond its first crossover."""

    def loop(w):
        s = 1j * w
        return 3.0 / s * 100.0**2 / (s**2 + 1.5 * s + 100.0**2) * np.exp(2.2j)

    found = margins(loop, 0.1, 1e3)
    first, *others = found.crossovers
    assert len(others) == 2
    assert first.omega == pytest.approx(3.0, rel=0.01)
    assert found.phase_margin == min((c.phase_margin for c in found.crossovers), key=abs)
    assert found.delay_margin == min(c.delay_margin for c in found.crossovers)
    assert found.delay_margin < first.delay_margin


def test_a_loop_that_never_reaches_one_has_infinite_margins():
    found = margins(lambda w: 0.5 / (1 + 1j * w), 0.01, 100.0)
    assert found.critical is None
    assert found.phase_margin == found.delay_margin == found.gain_margin == math.inf
