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


STEP = 0.004  # s


@pytest.fixture(scope="module")
def swinging() -> dict[str, np.ndarray]:
    """A second in which the centre of mass and the left foot move; the forces on the feet are any."""
    t = np.arange(0.0, 1.0, STEP)
    com = np.column_stack([0.03 * np.sin(3 * t), 0.83 + 0.01 * np.cos(4 * t)])
    left = np.column_stack([-0.15 + 0.3 * np.sin(2.5 * t) ** 2, 0.05 * np.sin(3 * t) ** 2])
    feet = np.stack([np.tile((0.15, 0.0), (len(t), 1)), left], axis=1)
    solved = [BIPED.posture(tuple(c), [tuple(foot) for foot in pair]) for c, pair in zip(com, feet, strict=True)]
    forces = np.stack([np.column_stack([12 * np.cos(t), 150 + t]), np.column_stack([-7 * t, 80 - t])], axis=1)
    return {
        "positions": np.array([angles for angles, _ in solved]), "torso": np.array([torso for _, torso in solved]),
        "feet": feet, "forces": forces,
    }  # fmt: skip


def motion(swinging: dict[str, np.ndarray], at: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, v, a of pinocchio's model at a sample, by differences."""
    torso, positions = swinging["torso"], swinging["positions"]
    moved = np.column_stack([torso[:, 0], 0 * torso[:, 0], torso[:, 1], np.zeros((len(torso), 3)), positions])
    v = (moved[at + 1] - moved[at - 1]) / (2 * STEP)
    a = (moved[at + 1] - 2 * moved[at] + moved[at - 1]) / STEP**2
    return configuration(tuple(torso[at]), 0.0, positions[at].tolist()), v, a


PLANAR = [1, 2, 4, 5]


def test_torques_are_those_of_inverse_dynamics(swinging: dict[str, np.ndarray]) -> None:
    """pinocchio's recursive Newton-Euler algorithm, and the feet's forces by virtual work."""
    torques = BIPED.torques(**swinging, step=STEP)
    data = MODEL.model.createData()
    for at in range(20, len(torques) - 20, 23):
        q, v, a = motion(swinging, at)
        MODEL.update(q, v)
        on_robot = np.insert(swinging["forces"][at], 1, 0.0, axis=1).ravel()
        expected = (pin.rnea(MODEL.model, data, q, v, a) - MODEL.Js.T @ on_robot)[6:]
        assert torques[at, PLANAR] == pytest.approx(expected[PLANAR], abs=0.02)


def test_spin_is_the_centroidal_angular_momentum(swinging: dict[str, np.ndarray]) -> None:
    spin = BIPED.spin(swinging["positions"], STEP)
    data = MODEL.model.createData()
    for at in range(20, len(spin) - 20, 23):
        q, v, _ = motion(swinging, at)
        expected = pin.computeCentroidalMomentum(MODEL.model, data, q, v).angular[1]
        assert spin[at] == pytest.approx(expected, abs=1e-3)
    assert np.abs(spin).max() > 0.3  # it is not that nothing turns


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
