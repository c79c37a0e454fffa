"""The identification against systems whose matrices are known."""

import numpy as np
import pytest

from hil.lab.linear.delay_model import DelayModel, memory, recurrence, refined


def some_matrices(seed, n=5, late=(1, 4), rank=2):
    """A_0 and a few late ones, through ``rank`` combinations of the states, of a loop that is stable."""
    rng = np.random.default_rng(seed)
    matrices = np.zeros((max(late) + 1, n, n))
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    matrices[0] = 0.7 * q
    combine = rng.normal(size=(rank, n)) / n
    for j in late:
        matrices[j] = 0.3 * rng.normal(size=(n, rank)) @ combine
    return matrices


def answers(matrices, periods):
    """Y(1) … of unit displacements without a past, by the equation itself."""
    n = matrices.shape[1]
    y = [np.eye(n)]
    for k in range(periods):
        y.append(sum(matrices[j] @ y[k - j] for j in range(min(k, len(matrices) - 1) + 1)))
    return np.array(y[1:])


def companion(matrices):
    m, n, _ = matrices.shape
    whole = np.zeros((m * n, m * n))
    whole[:n] = np.concatenate(list(matrices), axis=1)
    whole[n:, :-n] = np.eye((m - 1) * n)
    return whole


def largest(values, count):
    return np.sort_complex(np.round(values[np.argsort(-np.abs(values))][:count], 8))


@pytest.mark.parametrize("seed", range(5))
def test_the_matrices_come_back(seed):
    matrices = some_matrices(seed)
    found = recurrence(answers(matrices, 9))
    assert found[: len(matrices)] == pytest.approx(matrices, abs=1e-12)
    assert found[len(matrices) :] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_modes_are_those_of_the_companion_matrix(seed):
    matrices = some_matrices(seed)
    model = DelayModel.of(matrices, 1e-3, 1e-9)
    assert len(model.matrix) == 5 + 2 * 4  # two combinations for four periods, not five states
    values, vectors, shares = model.modes()
    known = np.linalg.eigvals(companion(matrices))
    assert largest(values, 8) == pytest.approx(largest(known, 8), abs=1e-7)
    for value, vector in zip(values[:8], vectors.T[:8], strict=True):
        residual = sum(a * value ** -float(j) for j, a in enumerate(matrices)) @ vector - value * vector
        assert np.abs(residual).max() < 1e-8
    assert shares.sum(axis=0) == pytest.approx(1.0)


def test_participation_does_not_depend_on_units():
    matrices = some_matrices(3)
    scale = np.array([1.0, 1e2, 1e-2, 7.0, 0.1])
    other = matrices * scale[:, None] / scale
    (values, _, first), (same, _, second) = (DelayModel.of(m, 1e-3, 1e-9).modes() for m in (matrices, other))
    for value, shares in zip(values[:8], first.T[:8], strict=True):
        twin = int(np.argmin(np.abs(same - value)))
        assert second[:5, twin] / second[:5, twin].sum() == pytest.approx(shares[:5] / shares[:5].sum(), abs=1e-6)


def test_a_state_of_its_own_participates_alone():
    matrices = np.diag([0.9, 0.5, 0.2])[None]
    values, _, shares = DelayModel.of(matrices, 1e-3, 1e-9).modes()
    assert values == pytest.approx([0.9, 0.5, 0.2])
    assert shares[:3] == pytest.approx(np.eye(3))


def test_least_squares_leaves_less_of_the_noise():
    matrices, level = some_matrices(1, late=(9,)), 1e-4
    noisy = answers(matrices, 24) + level * np.random.default_rng(2).normal(size=(24, 5, 5))
    raw = recurrence(noisy)
    better = refined(noisy, raw, 10 * level)
    assert memory(better) == 9

    def error(found):
        return np.abs(found[:10] - matrices).max()

    assert error(better) < 0.7 * error(raw)
    assert np.all(better[1:9] == 0.0)


def test_forgotten_memory_fades_and_does_not_end():
    """A state that is left out is no data under way: the A_j fall as it forgets."""
    full = np.array([[0.9, 0.2], [0.3, 0.5]])
    first = np.array([np.linalg.matrix_power(full, k)[:1, :1] for k in range(1, 8)])
    found = recurrence(first)[:, 0, 0]
    assert found[1:] == pytest.approx([0.06 * 0.5**j for j in range(6)])
