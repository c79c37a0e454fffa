"""The loop that a drive really closes: the plant between a zero-order hold and a sampler, the law as it is computed.

A demand that is computed at an interrupt takes effect ``delay`` later and is held. What is sensed at an interrupt is
used in it. All systems here are discrete, at the interrupt rate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import cont2discrete

from hil.joint_lab.actuator import StateSpace


class SampledLaw(NamedTuple):
    """A linear law: ``system`` from (sensed[n], torque commanded) to motor torque [N m]; n: what the plant senses."""

    system: StateSpace
    period: float  # s


class SampledPlant(NamedTuple):
    """From motor torque demanded to what is sensed; the last output is the motor torque that a current sensor sees."""

    system: StateSpace
    period: float  # s


def _held(model: StateSpace, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition over ``time`` with a constant input."""
    if time == 0.0:
        return np.eye(len(model.a)), np.zeros_like(model.b)
    a, b, *_ = cont2discrete((model.a, model.b, model.c, model.d), time)
    return a, b


def discretise(model: StateSpace, period: float, delay: float) -> SampledPlant:
    """``model`` (one input) exactly at its samples, with a hold that lags by ``delay`` s, of any length.

    States are the model's and the demands of the past samples that are under way, the newest first. A current sensor
    is read before a demand of the same instant takes effect.
    """
    whole = math.floor(delay / period + 1e-9)
    rest = max(delay - whole * period, 0.0)
    before, old = _held(model, rest)  # up to where the new demand takes effect
    after, new = _held(model, period - rest)
    n, m, outputs = len(model.a), whole + 1, len(model.c)
    a, b = np.zeros((n + m, n + m)), np.zeros((n + m, 1))
    a[:n, :n] = after @ before
    a[:n, n + m - 1 :] = after @ old  # demand of ``whole`` + 1 samples ago
    if whole:
        a[:n, n + whole - 1 : n + whole] += new
    else:
        b[:n] = new
    b[n] = 1.0
    a[n + 1 :, n : n + m - 1] += np.eye(m - 1)
    c = np.zeros((outputs + 1, n + m))
    c[:outputs, :n], c[outputs, n + m - 1] = model.c, 1.0
    return SampledPlant(StateSpace(a, b, c, np.zeros((outputs + 1, 1))), period)


def response(system: StateSpace, z: np.ndarray) -> np.ndarray:
    """Transfer matrices at complex ``z`` (n,): (n, outputs, inputs)."""
    resolvent = z[:, None, None] * np.eye(len(system.a)) - system.a
    b = np.broadcast_to(system.b, (len(z), *system.b.shape))
    return system.c @ np.linalg.solve(resolvent, b) + system.d


def open_loop(plant: SampledPlant, law: SampledLaw, omega: np.ndarray) -> np.ndarray:
    """The loop cut at the motor, positive when it counteracts, at ``omega`` rad/s (n,) below π / period."""
    z = np.exp(1j * omega * plant.period)
    sensed = response(plant.system, z)[:, :-1, :]
    return -(response(law.system, z)[:, :, :-1] @ sensed)[:, 0, 0]


def closed_loop(plant: SampledPlant, law: SampledLaw) -> StateSpace:
    """From torque commanded to the plant's outputs and, last, the motor torque that the law demands."""
    p, w = plant.system, law.system
    c, n = p.c[:-1], len(p.a)
    g, j = w.b[:, :-1], w.d[:, :-1]
    a = block_diag(p.a, w.a)
    a[:n, :n] += p.b @ j @ c
    a[:n, n:] = p.b @ w.c
    a[n:, :n] = g @ c
    b = np.vstack([p.b @ w.d[:, -1:], w.b[:, -1:]])
    outputs = np.vstack([block_diag(p.c, w.c)])
    outputs[-1, :n] = (j @ c).ravel()
    d = np.zeros((len(outputs), 1))
    d[-1] = w.d[:, -1]
    return StateSpace(a, b, outputs, d)


def spectral_radius(plant: SampledPlant, law: SampledLaw) -> float:
    """Of the closed loop: below one it is stable."""
    return float(np.abs(np.linalg.eigvals(closed_loop(plant, law).a)).max())


def at_reports(system: StateSpace, ratio: int, offset: int) -> StateSpace:
    """``system`` seen by its bus: reports are every ``ratio`` samples; a command acts ``offset`` (< ratio) after one.

    It goes from the command that acts in the interval that begins with a report to that report.
    """
    n = len(system.a)
    powers = [np.eye(n)]
    for _ in range(ratio):
        powers.append(powers[-1] @ system.a)
    sums = [np.zeros_like(system.b)]  # of a constant input, over so many samples
    for power in powers[:-1]:
        sums.append(sums[-1] + power @ system.b)
    a = np.zeros((n + 1, n + 1))
    a[:n, :n], a[:n, n:] = powers[ratio], powers[ratio - offset] @ sums[offset]
    b = np.vstack([sums[ratio - offset], [[1.0]]])
    c = np.hstack([system.c, system.d if offset else np.zeros_like(system.d)])
    return StateSpace(a, b, c, np.zeros_like(system.d) if offset else system.d)
