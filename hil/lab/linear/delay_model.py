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


def refined(responses: Array, matrices: Array, floor: float) -> Array:
    """The A_j by least squares over all periods at once, those whose entries are all within ``floor`` being zero.

    One after the other, each inherits the rounding errors of those before; with the zeros known there are many more
    equations than unknowns.
    """
    periods, n, _ = responses.shape
    support = [j for j in range(periods) if j == 0 or np.abs(matrices[j]).max() > floor]
    known = np.concatenate([np.eye(n)[None], responses])  # Y(0), Y(1), …
    past = np.zeros((len(support) * n, periods * n))
    for row, j in enumerate(support):
        for k in range(j, periods):
            past[row * n : (row + 1) * n, k * n : (k + 1) * n] = known[k - j]
    after = responses.transpose(1, 0, 2).reshape(n, periods * n)
    found = scipy.linalg.lstsq(past.T, after.T, lapack_driver="gelsy")[0].T
    result = np.zeros_like(matrices)
    for row, j in enumerate(support):
        result[j] = found[:, row * n : (row + 1) * n]
    return result


def memory(matrices: Array) -> int:
    """Number of periods back that matter: the largest j whose A_j is not zero."""
    return int(np.flatnonzero(np.abs(matrices).max(axis=(1, 2)))[-1])


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
        n, m = matrices.shape[1], memory(matrices)
        if m == 0:
            return cls(matrices[0].copy(), n, period)
        late = matrices[1 : m + 1]
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
