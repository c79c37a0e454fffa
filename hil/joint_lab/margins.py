"""Stability margins of a loop from its frequency response: phase, gain and delay margin, at every crossover."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

_POINTS_PER_DECADE = 400

Response = Callable[[np.ndarray], np.ndarray]  # complex response at angular frequencies, rad/s


class Crossover(NamedTuple):
    """Where the loop's magnitude is one."""

    omega: float  # rad/s
    phase_margin: float  # rad, in (−π, π]

    @property
    def delay_margin(self) -> float:
        """Delay that turns the loop's phase here to −π, s."""
        return (self.phase_margin % (2.0 * math.pi)) / self.omega


def critical(crossovers: Sequence[Crossover]) -> Crossover | None:
    """The crossover with the smallest phase margin; None without any."""
    return min(crossovers, key=lambda c: abs(c.phase_margin), default=None)


class Margins(NamedTuple):
    """Margins of a loop that is stable when closed; without a crossover they are infinite."""

    crossovers: tuple[Crossover, ...]  # by frequency
    phase_crossovers: tuple[tuple[float, float], ...]  # rad/s, and the gain that would make it the stability's limit

    @property
    def critical(self) -> Crossover | None:
        """The crossover with the smallest phase margin."""
        return critical(self.crossovers)

    @property
    def phase_margin(self) -> float:
        """rad, the smallest of all crossovers."""
        return math.inf if self.critical is None else self.critical.phase_margin

    @property
    def delay_margin(self) -> float:
        """s, the smallest of all crossovers: with several, not always that with the smallest phase margin."""
        return min((c.delay_margin for c in self.crossovers), default=math.inf)

    @property
    def gain_margin(self) -> float:
        """The factor nearest to one, in the logarithm, that makes the closed loop oscillate."""
        return min((gain for _, gain in self.phase_crossovers), key=lambda gain: abs(math.log(gain)), default=math.inf)


def frequencies(low: float, high: float) -> np.ndarray:
    """Angular frequencies between ``low`` and ``high`` rad/s, evenly spaced in the logarithm, (n,)."""
    return np.geomspace(low, high, max(int(_POINTS_PER_DECADE * math.log10(high / low)), 2))


def margins(loop: Response, low: float, high: float) -> Margins:
    """Margins of ``loop``, searched between ``low`` and ``high`` rad/s (of a sampled loop: below π over its period)."""
    omega = frequencies(low, high)
    values = loop(omega)

    def magnitude(w: float) -> float:
        return math.log(abs(complex(loop(np.array([w]))[0])))

    def imaginary(w: float) -> float:
        return float(loop(np.array([w]))[0].imag)

    crossovers = []
    for w in _roots(omega, np.log(np.abs(values)), magnitude):
        turned = -complex(loop(np.array([w]))[0])
        crossovers.append(Crossover(w, math.atan2(turned.imag, turned.real)))
    real = []
    for w in _roots(omega, values.imag, imaginary):
        at = float(loop(np.array([w]))[0].real)
        if at < 0.0:
            real.append((w, -1.0 / at))
    return Margins(tuple(crossovers), tuple(real))


def _roots(omega: np.ndarray, values: np.ndarray, function: Callable[[float], float]) -> list[float]:
    signs = np.sign(values)
    changes = np.flatnonzero(signs[:-1] * signs[1:] < 0)
    return [float(brentq(function, omega[i], omega[i + 1], xtol=1e-12, rtol=1e-12)) for i in changes]
