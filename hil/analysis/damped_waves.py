"""Frequencies and growth rates of a transient: a sum of damped waves fitted to its samples."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg


class Wave(NamedTuple):
    """frequency [Hz], growth [1/s], amplitude at the first sample [unit of the signal]."""

    frequency: float
    growth: float
    amplitude: float


def damped_waves(values: np.ndarray, interval: float, order: int = 30) -> list[Wave]:
    """The waves that evenly sampled ``values`` (n,), n > 2 ``order``, are made of, the largest first.

    By the matrix pencil (Hua, Sarkar, "Matrix pencil method for estimating parameters of exponentially damped/undamped
    sinusoids in noise", IEEE Trans. ASSP 38(5), 1990) of the ``order`` largest singular values. interval: s.

    Raises ValueError for too few values.
    """
    if len(values) <= 2 * order:
        raise ValueError(f"{len(values)} values: expected more than {2 * order}")
    half = len(values) // 2
    hankel = np.array([values[i : i + half + 1] for i in range(len(values) - half)])
    u, s, v = scipy.linalg.svd(hankel[:, :-1], full_matrices=False)
    rank = min(order, int(np.count_nonzero(s > 1e-13 * s[0])))
    poles = np.linalg.eigvals((u[:, :rank] / s[:rank]).T @ hankel[:, 1:] @ v[:rank].T)
    poles = poles[np.abs(poles) > 1e-9]
    powers = np.vander(poles, len(values), increasing=True).T
    amplitudes = np.linalg.lstsq(powers, values.astype(complex), rcond=None)[0]
    exponents = np.log(poles) / interval
    waves = [
        Wave(float(e.imag / (2.0 * math.pi)), float(e.real), float((2.0 if e.imag > 0 else 1.0) * abs(a)))
        for e, a in zip(exponents, amplitudes, strict=True)
        if e.imag >= 0.0
    ]
    return sorted(waves, key=lambda wave: -wave.amplitude)
