"""The size of displacements: of a loop that is linear near its operating point only, and known to some digits."""

import numpy as np
import pytest

from hil.lab.linear.linearisation import SCALES, Linearisation

PERIOD = 1e-3
GROWTH, HERTZ = -5.0, 10.0


class Spiral:
    """Two states that turn and fade. Beyond ``reach`` they are held by something else, as when a foot lifts; they are
    read in steps of ``step``."""

    names = ("a", "b")
    sizes = np.ones(2)
    period = PERIOD

    def __init__(self, reach: float, step: float) -> None:
        self._reach, self._step = reach, step
        turn = 2.0 * np.pi * HERTZ * PERIOD
        self._map = np.exp(GROWTH * PERIOD) * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def displace(self, by: np.ndarray) -> None:
        self._x = np.array(by)

    def advance(self) -> None:
        far = np.abs(self._x).max() > self._reach
        self._x = np.clip(3.0 * self._x, -5.0, 5.0) if far else self._map @ self._x

    def read(self) -> np.ndarray:
        return np.round(self._x / self._step) * self._step

    def difference(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return first - second


@pytest.mark.parametrize(("reach", "scale"), [(2.0, 1.0), (0.7, 0.5), (0.3, 0.25), (0.12, 0.1)])
def test_the_size_is_the_largest_that_leaves_little_noise(reach: float, scale: float) -> None:
    found = Linearisation.cleanest(Spiral(reach, 1e-5), 0.0)
    assert found.scale == scale and found.noise < 0.01
    assert (found.growth, found.dominant.frequency) == (pytest.approx(GROWTH, abs=0.2), pytest.approx(HERTZ, abs=0.1))
    assert found.doubt() is None and found.doubt(Linearisation.of(Spiral(reach, 1e-5), 0.0, 0.5 * scale)) is None


def test_between_lifting_and_rounding_the_size_with_least_noise_is_taken() -> None:
    section = Spiral(0.3, 0.03)
    found = Linearisation.cleanest(section, 0.0)
    assert found.scale == min(SCALES, key=lambda scale: Linearisation.of(section, 0.0, scale).noise) == 0.25


def test_a_loop_without_a_size_is_not_to_be_trusted() -> None:
    found = Linearisation.cleanest(Spiral(0.01, 1e-5), 0.0)
    assert found.noise > 1.0
    assert found.doubt().startswith("not to be trusted: a noise of ")


def test_a_verdict_that_half_of_the_displacements_turn_is_not_to_be_trusted() -> None:
    found, half = (Linearisation.of(Spiral(2.0, 1e-5), 0.0), Linearisation.of(Spiral(2.0, 1e-5), 0.0, 0.5))
    assert found.doubt(half) is None
    other = Spiral(2.0, 1e-5)
    other._map = other._map * np.exp(20.0 * PERIOD)
    assert "15/s instead of -5/s" in found.doubt(Linearisation.of(other, 0.0))
