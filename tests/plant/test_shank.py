"""Shanks that bend: statics against the cantilever, and joints found among more coordinates."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from hil.streams import streams
from plant import stance
from plant.config import (
    HoistConfig,
    MotionCaptureConfig,
    PlanarizerConfig,
    SensorConfig,
    StanceConfig,
    TerrainConfig,
    WorldConfig,
)
from plant.model import bends, build, coordinates, initial_qpos
from plant.world import World
from robots import description, motion_capture

HUME = description.load("hume")
START = stance.initial(HUME, StanceConfig())
STIFFNESS = 2000.0
BENT = ["right_knee_sagittal", "right_knee_lateral", "left_knee_sagittal", "left_knee_lateral"]


def model(stiffness: float, planarizer: bool = True) -> mujoco.MjModel:
    return build(HUME, START, TerrainConfig(), PlanarizerConfig(enabled=planarizer), 3000.0, stiffness)


@pytest.mark.parametrize("planarizer", [True, False])
def test_joints_are_found_and_the_robot_stands_as_if_rigid(planarizer: bool) -> None:
    rigid, bending = model(0.0, planarizer), model(STIFFNESS, planarizer)
    assert bends(rigid, HUME) == [] and bends(bending, HUME) == BENT
    assert bending.nv == rigid.nv + 4
    poses = []
    for built in (rigid, bending):
        data = mujoco.MjData(built)
        data.qpos[:] = initial_qpos(built, HUME, START)
        mujoco.mj_forward(built, data)
        at = coordinates(built, HUME.joint_names)
        np.testing.assert_array_equal(data.qpos[at.positions], START.joints)
        for k, name in enumerate(HUME.joint_names):
            assert built.joint(name).dofadr[0] == np.arange(built.nv)[at.velocities][k]
        poses.append(data.sensordata[:15].copy())  # base, com, feet
        mass = np.zeros((built.nv, built.nv))
        mujoco.mj_fullM(built, data, mass)
        poses.append(mass[at.velocities][:, at.velocities])
    np.testing.assert_allclose(poses[0], poses[2], atol=1e-4)  # a gram more
    extra = np.diag(poses[3] - poses[1])
    np.testing.assert_allclose(extra, [0.0, 0.0, 1e-3] * 2, atol=3e-4)  # the forks', and their gram on the legs' length


@pytest.mark.parametrize("axis", [0, 1])
def test_a_force_on_the_foot_bends_a_shank_as_a_cantilever(axis: int) -> None:
    """EI = stiffness L / 3: the tip gives by F L³ / (3 EI) = F L² / stiffness, across the shank."""
    built = model(STIFFNESS)
    built.opt.gravity[:] = 0.0
    data = mujoco.MjData(built)
    data.qpos[:] = initial_qpos(built, HUME, START)
    data.qpos[1] += 1.0  # off the ground
    mujoco.mj_forward(built, data)
    foot, tube = built.geom("right_foot").id, built.body("right_knee_tube").id
    across = data.xmat[tube].reshape(3, 3)[:, axis].copy()
    force, length = 20.0 * across, float(np.linalg.norm(HUME.feet[0].position))
    built.dof_armature[[built.joint(i).dofadr[0] for i in range(built.njnt) if built.joint(i).name not in BENT]] = 1e9
    before = data.geom_xpos[foot].copy()
    for _ in range(6000):
        data.xfrc_applied[tube, :3] = force
        data.xfrc_applied[tube, 3:] = np.cross(data.geom_xpos[foot] - data.xipos[tube], force)
        mujoco.mj_step(built, data)
    given = float((data.geom_xpos[foot] - before) @ across)
    assert given == pytest.approx(20.0 * length**2 / STIFFNESS, rel=1e-3)


def world(stiffness: str | int, cameras: MotionCaptureConfig | None = None) -> World:
    config = WorldConfig(shank_stiffness=stiffness, hoist=HoistConfig(hold="10s"))
    exact = SensorConfig(noise=0.0, bias=0.0)
    return World(
        HUME, config, TerrainConfig(), StanceConfig(), exact, [], streams(0),
        motion_capture=cameras or MotionCaptureConfig(),
    )  # fmt: skip


def test_encoders_see_the_joint_and_not_the_bending() -> None:
    node = world("2000Nm/rad")
    assert node.truth_fields[-4:] == [f"bend.{name}" for name in BENT]
    for _ in range(300):
        node.sample()
        node.latch()
        node.step()
    truth = dict(zip(node.truth_fields, node.truth().tolist(), strict=True))
    at = coordinates(node.model, HUME.joint_names)
    np.testing.assert_array_equal([truth[f"q.{name}"] for name in HUME.joint_names], node.data.qpos[at.positions])
    np.testing.assert_array_equal([truth[f"dq.{name}"] for name in HUME.joint_names], node.data.qvel[at.velocities])
    assert any(truth[f"bend.{name}"] for name in BENT)


def test_a_snapshot_repeats() -> None:
    node = world("2000Nm/rad")

    def steps() -> np.ndarray:
        for _ in range(50):
            node.sample()
            node.latch()
            node.step()
        return node.truth().copy()

    steps()
    state = node.snapshot()
    first = steps()
    node.restore(state)
    np.testing.assert_array_equal(steps(), first)


def test_rigid_shanks_are_views_of_what_was_there() -> None:
    node = world(0)
    assert np.shares_memory(node._q, node.data.qpos)
    assert not any(name.startswith("bend") for name in node.truth_fields)


def test_motion_capture_sees_the_bending_and_kinematics_does_not() -> None:
    """An LED at a foot against where base and joints, as a rigid model has them, put it (Kim 2018 §6.2)."""
    bent = world("2000Nm/rad", MotionCaptureConfig(enabled=True))
    bent.data.qpos[bent.model.joint("right_knee_sagittal").qposadr[0]] = 0.02
    mujoco.mj_forward(bent.model, bent.data)
    frame = motion_capture.decode(bent.motion_capture.expose(0, 0.0), HUME.motion_capture)
    rigid = world(0, MotionCaptureConfig(enabled=True))  # in the same pose
    known = motion_capture.decode(rigid.motion_capture.expose(0, 0.0), HUME.motion_capture)
    off = np.linalg.norm(frame.positions - known.positions, axis=1)
    right = HUME.motion_capture.names.index("right_foot")
    lever = np.linalg.norm(HUME.motion_capture.leds[right].position)
    assert off[right] == pytest.approx(0.02 * lever, rel=0.05)
    assert np.delete(off, right).max() < 1e-3
