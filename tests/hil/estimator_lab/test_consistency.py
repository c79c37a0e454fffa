"""The measure of consistency on errors that are drawn as a covariance says, and on others."""

from __future__ import annotations

import numpy as np
import pytest

from hil.estimator_lab.consistency import consistency, normalised


def squares(scale: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 3))
    covariance = root @ root.T
    errors = scale * rng.standard_normal((8, 500, 3)) @ root.T
    return np.array([[normalised(e, covariance) for e in run] for run in errors])


def test_errors_as_large_as_claimed() -> None:
    found = consistency(squares(1.0), np.full((8, 500), 3.0))
    assert found.ratio == pytest.approx(1.0, abs=0.05)
    assert found.within == pytest.approx(0.95, abs=0.03)
    assert found.low == pytest.approx(12.401 / 24, abs=1e-4)  # chi-square tables: 24 degrees of freedom
    assert found.high == pytest.approx(39.364 / 24, abs=1e-4)


def test_errors_larger_or_smaller_than_claimed() -> None:
    sure, unsure = (consistency(squares(scale), np.full((8, 500), 3.0)) for scale in (2.0, 0.5))
    assert sure.ratio == pytest.approx(4.0, rel=0.05)
    assert unsure.ratio == pytest.approx(0.25, rel=0.05)
    assert sure.within < 0.05 and unsure.within < 0.05
