"""Robot descriptions."""

import numpy as np
import pytest

from robots import description
from robots.description import Link, UnknownRobotError


@pytest.mark.parametrize(("variant", "mass"), [(None, 23.3522), ("srlib", 21.4612)])
def test_masses_are_the_published_ones(variant, mass):
    assert description.load("hume", variant).mass == pytest.approx(mass, abs=1e-6)


def test_every_description_loads():
    assert "hume" in description.available()
    for name in description.available():
        assert description.load(name).name == name


def test_legs_mirror_each_other():
    robot = description.load("hume")
    right, left = robot.joints[:3], robot.joints[3:]
    for a, b in zip(right, left, strict=True):
        assert a.name.replace("right", "left") == b.name
        np.testing.assert_array_equal(np.array(a.position) * [1, -1, 1], b.position)
        assert a.limits == b.limits


@pytest.mark.parametrize("name", [("nobody", None), ("hume", "nothing")])
def test_unknown_names_are_refused_with_the_known_ones(name):
    with pytest.raises(UnknownRobotError, match=r"hume|srlib"):
        description.load(*name)


@pytest.mark.parametrize("inertia", [(1.0, 1.0, 2.1), (0.0, 1.0, 1.0), (-1.0, 1.0, 1.0)])
def test_impossible_inertias_are_refused(inertia):
    with pytest.raises(ValueError, match="not that of a rigid body"):
        Link(mass=1.0, com=(0.0, 0.0, 0.0), inertia=inertia)
