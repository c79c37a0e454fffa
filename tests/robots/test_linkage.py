"""The linkage against plane geometry and finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robots.linkage import Linkage

LINKAGE = Linkage(crank=0.0435, base=0.25, offset=1.396, nominal=0.1)
angles = st.floats(-1.1, 1.5)


@given(angles)
def test_the_length_is_the_distance_of_the_two_pins(q):
    crank = LINKAGE.crank * np.exp(1j * (q + LINKAGE.offset))
    assert float(LINKAGE.length(q)) == pytest.approx(abs(crank - LINKAGE.base), rel=1e-12)


@given(angles)
def test_derivatives_are_those_of_finite_differences(q):
    h = 1e-5
    for function, derivative in (
        (LINKAGE.length, LINKAGE.arm),
        (LINKAGE.motor_coordinate, LINKAGE.ratio),
        (LINKAGE.ratio, LINKAGE.ratio_rate),
    ):
        difference = float(function(q + h) - function(q - h)) / (2 * h)
        assert float(derivative(q)) == pytest.approx(difference, rel=1e-6, abs=1e-8)


@given(angles)
def test_the_map_has_its_inverse(q):
    assert float(LINKAGE.joint_angle(LINKAGE.motor_coordinate(q))) == pytest.approx(q, abs=1e-9)


def test_nominal_coordinates_are_those_of_the_joint_there():
    assert float(LINKAGE.motor_coordinate(0.1)) == pytest.approx(0.0, abs=1e-12)
    assert float(LINKAGE.ratio(0.1)) == pytest.approx(1.0)


def test_the_longest_arm_is_the_crank():
    assert max(float(LINKAGE.arm(q)) for q in np.linspace(-1.1, 1.0, 4001)) == pytest.approx(0.0435, rel=1e-6)


def test_a_linkage_that_cannot_close_is_refused():
    with pytest.raises(ValueError, match="stretched out or folded"):
        Linkage(crank=0.04, base=0.2, offset=1.0, nominal=-1.1)
