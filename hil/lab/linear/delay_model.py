"""A sampled linear system with data under way, from its responses to displaced states.

Let x be all of a system's state but what is under way for a bounded time (frames, samples, the last command). What was
sent in a period follows from the states of that period and those before, so that at the section once per period

    x(k+1) = A_0 x(k) + A_1 x(k−1) + … + A_m x(k−m).

Displace one state after the other while what is under way is left alone: the responses Y(k), one column per state, with
Y(0) = 1 and no past, give the A_j exactly, one after the other,

    A_j = Y(j+1) − A_0 Y(j) − … − A_{j−1} Y(1).

No frame is ever opened. Memory that was forgotten shows: the A_j then do not end with the delay, but fade with that
memory. What passes through the delays is much less than the states (a command per joint): with the few combinations
R x that it depends on, A_j = L_j R for j > 0, the system is a matrix over x and the R x of the last m periods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

Array = np.ndarray


def recurrence(responses: Array) -> Array:
    """The matrices A_j (m + 1, n, n) from the responses Y(1) … Y(m + 1), (m + 1, n, n), of unit displacements."""
    matrices = np.empty_like(responses)
    for j in range(len(responses)):
        matrices[j] = responses[j]
        for i in range(j):
            matrices[j] -= matrices[i] @ responses[j - 1 - i]
    return matrices


def memory(matrices: Array, floor: float) -> int:
    """Number of periods back that matter: the largest j whose A_j is above ``floor``, entry by entry."""
    above = np.flatnonzero(np.abs(matrices).max(axis=(1, 2)) > floor)
    return int(above[-1]) if len(above) else 0


@dataclass(frozen=True)
class DelayModel:
    """x(k+1) = Σ A_j x(k−j) as one matrix.

    matrix: (n + r m, n + r m) over x and R x of the last m periods. states: n. period: s.
    """

    matrix: Array
    states: int
    period: float

    @classmethod
    def of(cls, matrices: Array, period: float, floor: float) -> DelayModel:
        """From the A_j; combinations of states whose effect is below ``floor`` are left out."""
        n, m = matrices.shape[1], memory(matrices, floor)
        if m == 0:
            return cls(matrices[0].copy(), n, period)
        late = matrices[1 : m + 1].copy()
        late[np.abs(late).max(axis=(1, 2)) <= floor] = 0.0  # periods in which nothing arrives
        _, values, rows = np.linalg.svd(late.reshape(m * n, n), full_matrices=False)
        r = max(int(np.count_nonzero(values > floor)), 1)
        combine = rows[:r]
        matrix = np.zeros((n + r * m, n + r * m))
        matrix[:n, :n] = matrices[0]
        for j in range(m):
            matrix[:n, n + r * j : n + r * (j + 1)] = late[j] @ combine.T
        matrix[n : n + r, :n] = combine
        matrix[n + r :, n : n + r * (m - 1)] = np.eye(r * (m - 1))
        return cls(matrix, n, period)

    def modes(self) -> tuple[Array, Array, Array]:
        """Eigenvalues (N,) by falling size, their vectors on the states (n, N), and the participation (n + 1, N).

        The participation of a state is |w v|, of the left and right eigenvectors' entries, which does not depend on
        its unit (Pérez-Arriaga, Verghese, Schweppe, "Selective modal analysis", IEEE Trans. PAS 101(9), 1982); the
        last row is what is under way; a column adds up to 1.
        """
        n = self.states
        values, left, right = scipy.linalg.eig(self.matrix, left=True)
        order = np.argsort(-np.abs(values), kind="stable")
        values, left, right = values[order], left[:, order], right[:, order]
        products = np.abs(left * right)  # eig's left vectors are w of wᴴ A = λ wᴴ: conj(w) v, in size w v
        total = products.sum(axis=0)
        total[total == 0.0] = 1.0
        shares = products / total
        return values, right[:n], np.vstack([shares[:n], shares[n:].sum(axis=0)])
