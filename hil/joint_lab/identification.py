"""Frequency responses from samples, with coherence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import csd

_BANDS_PER_OCTAVE = 24


class Measured(NamedTuple):
    """Responses at ``omega`` rad/s, (n,): averages over bands of finer frequencies."""

    omega: np.ndarray
    values: np.ndarray  # complex
    coherence: np.ndarray  # in [0, 1]
    fine: np.ndarray  # rad/s, (m,): the frequencies that were averaged
    weights: np.ndarray  # (m,) of each in its band's average
    starts: np.ndarray  # (n,) where each band begins

    def averaged(self, values: np.ndarray) -> np.ndarray:
        """``values`` at the finer frequencies (m,) averaged as the measured ones were, (n,)."""
        return np.add.reduceat(self.weights * values, self.starts)


def frequency_response(u: np.ndarray, y: np.ndarray, rate: float, period: int, low: float, high: float) -> Measured:
    """Response from ``u`` to ``y`` (both (m,), ``rate`` Hz) between ``low`` and ``high`` Hz.

    The samples are cut into windows of ``period``, each of which begins and ends at rest: so nothing leaks between
    frequencies, and no window function is needed. Spectra are averaged over the windows, and over bands of a 24th of
    an octave, which is what takes the sensors' resolution out of the high frequencies. So is the coherence.
    """
    how = {"fs": rate, "window": "boxcar", "nperseg": period, "noverlap": 0, "detrend": "constant"}
    hertz, cross = csd(u, y, **how)
    inputs, outputs = csd(u, u, **how)[1].real, csd(y, y, **how)[1].real
    inside = np.flatnonzero((hertz >= low) & (hertz <= high))
    band = np.floor(_BANDS_PER_OCTAVE * np.log2(hertz[inside] / low))
    starts = np.flatnonzero(np.diff(band, prepend=-1.0))

    cross, inputs, outputs = cross[inside], inputs[inside], outputs[inside]
    total = np.add.reduceat(inputs, starts)
    weights = inputs / np.repeat(total, np.diff(starts, append=len(inside)))
    both = total * np.add.reduceat(outputs, starts)
    coherence = np.divide(np.abs(np.add.reduceat(cross, starts)) ** 2, both, out=np.zeros_like(both), where=both > 0)
    fine = 2.0 * np.pi * hertz[inside]
    measured = Measured(np.empty(0), np.add.reduceat(cross, starts) / total, coherence, fine, weights, starts)
    return measured._replace(omega=measured.averaged(fine))
