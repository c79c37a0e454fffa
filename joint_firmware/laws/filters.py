"""A second-order Butterworth low-pass with its two derivatives, by Tustin's method prewarped at the cutoff.

    Q(s) = w² / (s² + √2 w s + w²);      s Q and s² Q come out beside it

Its two integrators s⁻¹ become h (z + 1)/(z − 1) with h = tan(w dt/2) / w, so that the response at w is the continuous
one's. The states are those of the integrators, whatever is read from them: what follows may change without a bump.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca

_SQRT2 = math.sqrt(2.0)


class Filtered(NamedTuple):
    """Outputs of the filter at one input, and its states of the next tick."""

    low: ca.SX
    rate: ca.SX
    acceleration: ca.SX
    next: tuple[ca.SX, ca.SX]


class LowPass:
    """Q as a function of two states, its cutoff w [rad/s] and half step h [s]."""

    def __init__(self, first: ca.SX, second: ca.SX, w: ca.SX, h: ca.SX) -> None:
        self._first, self._second, self._w, self._h = first, second, w, h
        self._scale = 1 / (1 + _SQRT2 * h * w + (h * w) ** 2)
        self.at_once = (h * w) ** 2 * self._scale  # share of the input that reaches ``low`` in the same tick
        self.stored = self._scale * ((1 + _SQRT2 * h * w) * first + h * second)  # ``low`` without an input

    def filter(self, value: ca.SX) -> Filtered:
        w, h = self._w, self._h
        low = self.stored + self.at_once * value
        rate = self._scale * (self._second + h * w * w * (value - self._first))
        acceleration = w * w * (value - low) - _SQRT2 * w * rate
        return Filtered(low, rate, acceleration, (2 * low - self._first, 2 * rate - self._second))


def half_step(cutoff: float, dt: float) -> float:
    """h of a cutoff [rad/s] at the step ``dt`` [s]. Raises ValueError for one at or above half the rate."""
    if cutoff * dt >= math.pi:
        hertz = 0.5 / math.pi * cutoff
        raise ValueError(f"cutoff of {hertz:g} Hz: expected less than half of the rate of {1 / dt:g} Hz")
    return math.tan(0.5 * cutoff * dt) / cutoff
