"""Stiffness that the robot shows at its centre of mass when it is pushed (Kim 2018 Fig. 5.3c)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CUTOFF = 2.0  # Hz; what is slower counts as quasi-static
_BASELINE = 0.25  # s before a push: where the CoM was
_MARGIN = 0.25  # s on either side of a push: the low-pass smears its edges over this
_FORCE = 1e-3  # N; less is no push: a higher threshold would take the foot of a ramp for rest


@dataclass(frozen=True)
class Stiffness:
    """stiffness [N/m] of a quasi-static push, from ``samples`` rows."""

    stiffness: float
    samples: int


def fit_stiffness(times: np.ndarray, force: np.ndarray, displacement: np.ndarray) -> Stiffness | None:
    """Stiffness in one direction from pushes in that direction.

    Force and displacement are low-passed alike, without delay, and each push's displacement is taken from where the
    CoM was just before. The compliance is regressed, displacement on force, as the force is known exactly: noise in
    the displacement then leaves no bias. Over a whole push (from rest to rest) what velocity contributes cancels.

    Args:
        times: (n,), s, evenly spaced.
        force: (n,), N, along the direction.
        displacement: (n,), m, of the CoM from its reference.

    Returns:
        None if there was no push, or it did not move the CoM against a restoring force.
    """
    pushed = np.abs(force) > _FORCE
    if not pushed.any() or len(times) < 64:
        return None
    from scipy.signal import butter, sosfiltfilt

    rate = (len(times) - 1) / (times[-1] - times[0])
    low_pass = butter(2, CUTOFF, fs=rate, output="sos")
    edges = np.diff(np.concatenate([[0], pushed.astype(np.int8), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    work = energy = 0.0
    samples = 0
    slow_force = sosfiltfilt(low_pass, force)
    for start, end in zip(starts, ends, strict=True):
        before = slice(max(start - int(_BASELINE * rate), 0), max(start, 1))
        offset = float(np.mean(displacement[before]))
        rows = slice(max(start - int(_MARGIN * rate), 0), min(end + int(_MARGIN * rate), len(times)))
        moved = sosfiltfilt(low_pass, displacement - offset)[rows]
        work += float(slow_force[rows] @ moved)
        energy += float(slow_force[rows] @ slow_force[rows])
        samples += int(end - start)
    if work <= 0.0 or energy <= 0.0:
        return None
    return Stiffness(energy / work, samples)
