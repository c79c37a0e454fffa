"""The signal that a frequency response is measured with: sweeps of several sizes, with rests between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import chirp
from scipy.signal.windows import tukey

SIZES = (1.0, -1.0, 0.6, -0.6)  # of the sweeps: what does not grow with them costs coherence
_TAPER = 0.02  # share of a sweep at either end


class Sweeps(NamedTuple):
    """Logarithmic chirps ``low`` to ``high`` Hz of ``duration`` s, each behind a rest of ``rest`` s."""

    low: float
    high: float
    duration: float
    amplitude: float  # N m, of the largest
    rest: float = 0.75  # what oscillates must have died away by its middle

    def period(self, rate: float) -> int:
        """Samples from the start of a sweep to that of the next, at ``rate`` Hz."""
        return round(self.rest * rate) + round(self.duration * rate)

    def samples(self, rate: float) -> np.ndarray:
        """All sweeps and a last rest, at ``rate`` Hz."""
        n = round(self.duration * rate)
        t = np.arange(n) / rate
        sweep = chirp(t, self.low, self.duration, self.high, method="logarithmic", phi=-90.0) * tukey(n, 2 * _TAPER)
        rest = np.zeros(round(self.rest * rate))
        parts = [part for size in SIZES for part in (rest, size * self.amplitude * sweep)]
        return np.concatenate([*parts, rest])
