"""Frequency responses from samples, with coherence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import csd

_BANDS_PER_OCTAVE = 24


class Measured(NamedTuple):
    """Responses at ``omega`` rad/s, (n,)."""

    omega: np.ndarray
    values: np.ndarray  # complex
    coherence: np.ndarray  # in [0, 1]


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

    def averaged(spectrum: np.ndarray) -> np.ndarray:
        return np.add.reduceat(spectrum[inside], starts)

    weight = averaged(inputs)
    centre = averaged(inputs * hertz) / weight
    values = averaged(cross) / weight
    coherence = np.abs(averaged(cross)) ** 2 / (weight * averaged(outputs))
    return Measured(2.0 * np.pi * centre, values, coherence)
