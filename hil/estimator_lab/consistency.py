"""Whether a filter's covariance is true: squared errors, normalised by it, beside their chi-square bounds.

The normalised error squared of the estimate (NEES, needs the truth) and of the innovation (NIS, does not) are
chi-square numbers of as many degrees of freedom as they have components. Over M runs their sum is one of M times as
many; in time they are correlated, so each instant is judged by itself: of a consistent filter 95 % lie within.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

CONFIDENCE = 0.95


class Consistency(NamedTuple):
    """``ratio``: mean per degree of freedom; 1 when consistent, more when the filter is too sure of itself, less when
    not sure enough. ``low``, ``high``: bounds of the ratio at one instant (of the median degrees of freedom).
    ``within``: share of instants inside theirs."""

    ratio: float
    low: float
    high: float
    within: float


def consistency(values: np.ndarray, freedoms: np.ndarray) -> Consistency:
    """From normalised squares (runs, instants) and their degrees of freedom, of the same shape."""
    total, degrees = values.sum(axis=0), freedoms.sum(axis=0)
    tail = (1 - CONFIDENCE) / 2
    low, high = chi2.ppf(tail, degrees), chi2.ppf(1 - tail, degrees)
    typical = np.median(degrees)
    return Consistency(
        ratio=float(total.sum() / degrees.sum()),
        low=float(chi2.ppf(tail, typical) / typical),
        high=float(chi2.ppf(1 - tail, typical) / typical),
        within=float(np.mean((low <= total) & (total <= high))),
    )


def normalised(error: np.ndarray, covariance: np.ndarray) -> float:
    """errorᵀ covariance⁻¹ error."""
    return float(error @ np.linalg.solve(covariance, error))
