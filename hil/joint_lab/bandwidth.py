"""Bandwidth of a closed loop: up to where its output follows what it is told."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from hil.joint_lab import sampled
from hil.joint_lab.margins import Response, frequencies
from hil.joint_lab.setup import Setup

_FALL = math.sqrt(0.5)  # 3 dB
_LOW = 0.01  # rad/s
_BELOW = 0.999  # of the Nyquist frequency


def bandwidth(closed: Response, low: float, high: float) -> float | None:
    """Where the magnitude of ``closed`` first falls to 3 dB below that at ``low``, rad/s; None if it does not up to
    ``high``."""
    omega = frequencies(low, high)
    reference = _FALL * abs(complex(closed(np.array([low]))[0]))
    below = np.flatnonzero(np.abs(closed(omega)) < reference)
    if not len(below):
        return None
    first = int(below[0])
    return float(brentq(lambda w: abs(complex(closed(np.array([w]))[0])) - reference, omega[first - 1], omega[first]))


def torque_bandwidth(setup: Setup) -> float | None:
    """Of the torque that the joint's drive closes its loop on, over the one commanded, Hz; None if the loop is unstable
    when closed, or has no end below half the interrupt rate.

    Raises ValueError for a load that is not linear.
    """
    plant, law = setup.plant(), setup.law()
    if sampled.spectral_radius(plant, law) > 1.0 + 1e-6:  # unused integrators are at one, up to rounding
        return None
    system = sampled.closed_loop(plant, law)

    def torque(omega: np.ndarray) -> np.ndarray:
        return sampled.response(system, np.exp(1j * omega * setup.period))[:, 1, 0]  # deflection, or effort

    found = bandwidth(torque, _LOW, _BELOW * setup.nyquist)
    return None if found is None else found / (2.0 * math.pi)
