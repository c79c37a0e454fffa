"""What the swing leg's angular momentum asks of the centre of mass.

The force on a pendulum goes through its centre of mass, about which its angular momentum L stays. A leg that swings has
some: on a point foot the body turns against it, and with joints that follow a plan which does not know of it the whole
robot falls away from the plan. (Kim 2018 §7.1.6 sees that turn, after "the unmodeled motion of swing leg", §7.1.7, and
adds a boost of speed by hand.) With the height over time kept, a deviation e from the pendulum's way obeys

    e'' = w² e + p + r,    w² = F_z / (M' h),    p = −(dL/dt) / (M' h)

M' the mass moved along x, h the height above the foot, and r = 0 on a point foot. On both feet r moves the centre of
pressure by −r / w².
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve


def deviation(step: float, square: np.ndarray, push: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """The deviation e [m], (n,): r = 0 where ``alone``, the least sum of r² elsewhere, at rest at 0 at both ends.

    Args:
        step: between the samples [s].
        square: w² [1/s²], (n,).
        push: p [m/s²], (n,).
        alone: whether one foot stands alone, (n,); not at the first and last two samples.
    """
    n = len(push)
    second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n), format="csr")  # step² e''
    rows = second - sparse.diags_array(step**2 * square[1:-1], offsets=1, shape=(n - 2, n), format="csr")
    wanted, inner = step**2 * push[1:-1], alone[1:-1]
    ends = sparse.csr_array((np.ones(4), (np.arange(4), [0, 1, n - 2, n - 1])), shape=(4, n))
    held, free = sparse.vstack([rows[inner], ends]), rows[~inner]
    system = sparse.block_array([[free.T @ free, held.T], [held, None]], format="csc")
    return spsolve(system, np.concatenate([free.T @ wanted[~inner], wanted[inner], np.zeros(4)]))[:n]
