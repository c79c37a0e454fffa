"""Planar kinematics of Hume against pinocchio's model of the whole robot."""

import math

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from central_controller.model import RobotModel
from central_controller.planning.planar import PlanarBiped
from robots import description

ROBOT = description.load("hume")
BIPED, MODEL = PlanarBiped(ROBOT), RobotModel(ROBOT)


def configuration(torso: tuple[float, float], pitch: float, angles: list[float]) -> np.ndarray:
    return np.array([torso[0], 0.0, torso[1], 0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2), *angles])


@given(
    x=st.floats(-0.1, 0.1), z=st.floats(0.75, 0.9), pitch=st.floats(-0.3, 0.3),
    right=st.tuples(st.floats(-0.25, 0.25), st.floats(0.0, 0.1)),
    left=st.tuples(st.floats(-0.25, 0.25), st.floats(0.0, 0.1)),
)  # fmt: skip
def test_feet_and_centre_of_mass_are_where_they_should_be(
    x: float, z: float, pitch: float, right: tuple[float, float], left: tuple[float, float]
) -> None:
    """Kim 2018 (7.1)–(7.4), with the whole robot's centre of mass in place of the hip."""
    angles, torso = BIPED.posture((x, z), [right, left], pitch)
    MODEL.update(configuration(torso, pitch, angles), np.zeros(12))
    assert MODEL.feet[:, [0, 2]] == pytest.approx(np.array([right, left]), abs=1e-8)
    assert MODEL.com[[0, 2]] == pytest.approx([x, z], abs=1e-8)
    assert angles[2] > 0 and angles[5] > 0  # both knees in front


def test_torques_hold_the_forces_by_virtual_work() -> None:
    feet, forces = [(0.15, 0.0), (-0.15, 0.03)], [(12.0, 150.0), (-7.0, 80.0)]
    angles, torso = BIPED.posture((0.03, 0.83), feet, 0.1)
    MODEL.update(configuration(torso, 0.1, angles), np.zeros(12))
    on_robot = np.array([[fx, 0.0, fz] for fx, fz in forces]).ravel()
    expected = -(MODEL.Js.T @ on_robot)[6:]
    planar = [1, 2, 4, 5]
    assert np.array(BIPED.torques(torso, 0.1, angles, feet, forces))[planar] == pytest.approx(expected[planar])


def test_out_of_reach_is_told() -> None:
    with pytest.raises(ValueError, match=r"right_foot would be .* out of reach of 0.928 m"):
        BIPED.posture((0.0, 1.2), [(0.15, 0.0), (-0.15, 0.0)])


def test_other_legs_are_refused() -> None:
    with pytest.raises(ValueError, match="need legs of abduction, hip and knee"):
        leg = ROBOT.joints[1].model_copy(update={"axis": (1.0, 0.0, 0.0)})
        PlanarBiped(ROBOT.model_copy(update={"joints": (ROBOT.joints[0], leg, *ROBOT.joints[2:])}))


def test_pinocchio_is_a_different_computation() -> None:
    """The two must not share code: pinocchio's data of this configuration are those of its own forward kinematics."""
    angles, torso = BIPED.posture((0.0, 0.83), [(0.15, 0.0), (-0.15, 0.0)])
    data = MODEL.model.createData()
    com = pin.centerOfMass(MODEL.model, data, configuration(torso, 0.0, angles))
    assert com[[0, 2]] == pytest.approx([0.0, 0.83], abs=1e-8)
