"""The deviation that a swing leg's momentum asks for, against the equation integrated by another method."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from central_controller.planning.swing_momentum import deviation

STEP = 0.004
TIMES = np.arange(0.0, 2.0, STEP)
ALONE = (TIMES > 0.7) & (TIMES < 1.2)
SQUARE = 10.0 + np.sin(TIMES)
PUSH = np.where(ALONE, 0.5 * np.sin(2 * np.pi * (TIMES - 0.7) / 0.5), 0.0)


def test_on_one_foot_it_obeys_the_pendulum() -> None:
    e = deviation(STEP, SQUARE, PUSH, ALONE)
    first, last = np.flatnonzero(ALONE)[[0, -1]]
    speed = (e[first + 1] - e[first - 1]) / (2 * STEP)
    solved = solve_ivp(
        lambda t, y: [y[1], np.interp(t, TIMES, SQUARE) * y[0] + np.interp(t, TIMES, PUSH)],
        (TIMES[first], TIMES[last]), [e[first], speed], rtol=1e-9, atol=1e-12, max_step=STEP,
        t_eval=TIMES[first : last + 1],
    )  # fmt: skip
    assert e[first : last + 1] == pytest.approx(solved.y[0], abs=2e-5)
    assert np.abs(e).max() > 1e-3


def test_it_is_at_rest_at_both_ends() -> None:
    e = deviation(STEP, SQUARE, PUSH, ALONE)
    assert e[[0, 1, -2, -1]] == pytest.approx(0.0, abs=1e-12)


def test_no_other_deviation_moves_the_pressure_less() -> None:
    """A change that starts and ends at rest within double support makes the sum of r² greater."""
    e = deviation(STEP, SQUARE, PUSH, ALONE)

    def effort(e: np.ndarray) -> float:
        r = np.diff(e, 2) / STEP**2 - (SQUARE * e + PUSH)[1:-1]
        return float(np.sum(r[~ALONE[1:-1]] ** 2))

    rng = np.random.default_rng(7)
    for _ in range(20):
        begin, length = rng.integers(5, 60), rng.integers(20, 100)
        bump = np.zeros(len(TIMES))
        bump[begin : begin + length] = rng.choice([-1, 1]) * 1e-4 * np.hanning(length) ** 2
        assert effort(e + bump) > effort(e)


def test_without_a_push_nothing_deviates() -> None:
    assert deviation(STEP, SQUARE, np.zeros(len(TIMES)), ALONE) == pytest.approx(0.0, abs=1e-15)
