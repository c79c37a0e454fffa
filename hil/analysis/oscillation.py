"""Dominant oscillation of a signal and whether it grows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_PERIODS = 3  # fewest periods in the window for a growth rate to mean anything
_ENVELOPE = 12  # envelope points to aim at


@dataclass(frozen=True)
class Oscillation:
    """frequency [Hz]; amplitude [unit of the signal] at the end; growth [1/s] of the amplitude's exponential and
    its standard error [1/s]."""

    frequency: float
    amplitude: float
    growth: float
    growth_error: float

    def grows(self, rate: float, amplitude: float) -> bool:
        """Whether it is beyond ``amplitude`` and grows by two standard errors more than ``rate``."""
        return self.amplitude > amplitude and self.growth - 2.0 * self.growth_error > rate


def dominant_oscillation(times: np.ndarray, values: np.ndarray, window: float = 3.0) -> Oscillation | None:
    """The strongest oscillation over the last ``window`` seconds of evenly sampled ``values``.

    A cubic is removed first, so that a slow path is not taken for an oscillation; for the same reason only
    frequencies with at least three periods in the window count. The frequency is the peak of the Hann-windowed
    spectrum. The signal is then demodulated at it over whole periods, and the growth rate is the slope of the
    logarithm of the amplitudes found.

    Args:
        times: (n,), s, evenly spaced.
        values: (n,), finite.
        window: s.

    Returns:
        None if the record is shorter than the window, or there is nothing that oscillates.
    """
    if len(times) < 16 or times[-1] - times[0] < 0.98 * window:
        return None
    last = times >= times[-1] - window
    t = times[last] - times[last][0]
    x = np.asarray(values, float)[last]
    if not np.all(np.isfinite(x)):
        return None
    scaled = 2.0 * t / t[-1] - 1.0
    x = x - np.polynomial.polynomial.polyval(scaled, np.polynomial.polynomial.polyfit(scaled, x, 3))
    rate = (len(t) - 1) / t[-1]
    frequency = _peak(x, rate, _PERIODS / window)
    if frequency is None:
        return None
    per_point = max(1, int(frequency * t[-1] / _ENVELOPE))
    length = round(per_point * rate / frequency)
    count = len(x) // length
    if count < _PERIODS - 1 or length < 4:
        return None
    start = len(x) - count * length  # the newest samples are always in
    pieces = x[start:].reshape(count, length)
    pieces = pieces - pieces.mean(axis=1, keepdims=True)
    phase = np.exp(-2j * np.pi * frequency * t[start:].reshape(count, length))
    amplitudes = 2.0 * np.abs((pieces * phase).mean(axis=1))
    if np.any(amplitudes <= 0.0):
        return None
    centres = t[start:].reshape(count, length).mean(axis=1)
    growth, error = _slope(centres, np.log(amplitudes))
    at_end = np.log(amplitudes).mean() + growth * (t[-1] - centres.mean())
    return Oscillation(frequency, float(np.exp(at_end)), growth, error)


def _peak(x: np.ndarray, rate: float, lowest: float) -> float | None:
    """Frequency of the largest peak of the spectrum at or above ``lowest``, Hz."""
    n = 4 * len(x)
    spectrum = np.abs(np.fft.rfft(x * np.hanning(len(x)), n))
    spectrum[: int(np.ceil(lowest * n / rate))] = 0.0
    k = int(np.argmax(spectrum[: int(0.4 * n)]))
    if spectrum[k] <= 1e-15:
        return None
    offset = 0.0
    if 0 < k < len(spectrum) - 1 and spectrum[k - 1] > 0 and spectrum[k + 1] > 0:
        left, centre, right = np.log(spectrum[k - 1 : k + 2])
        curvature = left - 2.0 * centre + right
        offset = float(0.5 * (left - right) / curvature) if curvature < 0 else 0.0
    return float((k + np.clip(offset, -0.5, 0.5)) * rate / n)


def _slope(t: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Least-squares slope and its standard error (infinite for fewer than three points)."""
    t = t - t.mean()
    slope = float(t @ y / (t @ t))
    if len(t) < 3:
        return slope, float("inf")
    residual = y - y.mean() - slope * t
    return slope, float(np.sqrt(residual @ residual / (len(t) - 2) / (t @ t)))
