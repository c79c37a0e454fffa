"""What carries a planned motion: against statics, by balances of forces and moments."""

import numpy as np
import pytest

from central_controller.planning import support

TIMES = np.linspace(0.0, 1.0, 11)
FEET = np.tile([(0.15, 0.0), (-0.15, 0.08)], (11, 1, 1))  # one on a block
BOTH = np.full(11, support.BOTH)


def test_who_stands() -> None:
    assert support.stance(TIMES, [(0.25, 0.55, 0), (0.75, 0.85, 1)]).tolist() == [
        -1,
        -1,
        -1,
        0,
        0,
        0,
        -1,
        -1,
        1,
        -1,
        -1,
    ]


@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_moments_balance_about_the_centre_of_mass(spin: float) -> None:
    """Forces along one line on both feet, with what share tells, turn the robot as fast as ``spin`` says."""
    com = np.column_stack([np.linspace(-0.1, 0.1, 11), np.full(11, 0.83)])
    force = np.column_stack([np.linspace(-20.0, 20.0, 11), np.linspace(200.0, 250.0, 11)])
    share, pressure = support.supported(com, force, np.full(11, spin), FEET, BOTH)
    inside = (share > 0.0) & (share < 1.0)
    assert inside.sum() > 5
    moment = np.zeros(11)
    for foot, part in ((0, share), (1, 1.0 - share)):
        arm = FEET[:, foot] - com
        moment += part * (arm[:, 1] * force[:, 0] - arm[:, 0] * force[:, 1])  # about +y
    assert moment[inside] == pytest.approx(spin)
    assert pressure[inside] == pytest.approx(-0.15 + 0.3 * share[inside])


def test_alone_a_foot_carries_all() -> None:
    com, force = np.tile((0.2, 0.83), (11, 1)), np.tile((30.0, 200.0), (11, 1))
    for foot, height in ((0, 0.0), (1, 0.08)):
        share, pressure = support.supported(com, force, np.zeros(11), FEET, np.full(11, foot))
        assert share.tolist() == [1.0 - foot] * 11
        assert pressure == pytest.approx(0.2 - 30.0 / 200.0 * (0.83 - height))


def test_the_ground_does_not_pull() -> None:
    support.check_pressed(TIMES, np.full(11, 1.0))
    with pytest.raises(ValueError, match=r"would fall faster than freely 0\.40 s after the start"):
        support.check_pressed(TIMES, np.where(np.arange(11) == 4, -1.0, 200.0))


@pytest.mark.parametrize(
    "x, where", [(-0.17, "20 mm behind the rear foot 0.30 s"), (0.16, "10 mm in front of the front foot 0.30 s")]
)
def test_the_centre_of_pressure_is_between_the_feet(x: float, where: str) -> None:
    pressure = np.where(np.arange(11) == 3, x, 0.0)
    with pytest.raises(ValueError, match=where):
        support.check_between(TIMES, pressure, FEET, BOTH)
    support.check_between(TIMES, pressure, FEET, np.where(np.arange(11) == 3, 0, support.BOTH))  # one foot: no matter
