"""Feet on the ground neither creep nor sink in, and slide at the friction limit."""

import mujoco
import numpy as np
import pytest

from plant import stance
from plant.config import PlanarizerConfig, StanceConfig, TerrainConfig
from plant.model import build, initial_qpos
from robots import description

ROBOT = description.load("hume")


def pulled(share):
    """Speed (2,) [m/s] and penetration (2,) [m] of the feet; the pull is ``share`` of the friction limit."""
    terrain = TerrainConfig()
    start = stance.initial(ROBOT, StanceConfig())
    model = build(ROBOT, start, terrain, PlanarizerConfig(), 3000.0)
    data = mujoco.MjData(model)
    data.qpos[:] = initial_qpos(model, ROBOT, start)
    weight = ROBOT.mass * ROBOT.gravity
    reference = data.qpos[-6:].copy()
    feet = [model.geom(foot.name).id for foot in ROBOT.feet]
    before = np.zeros((2, 3))
    for i in range(4500):
        data.qfrc_applied[0] = share * terrain.friction * weight * min(1.0, i / 1500)
        data.qfrc_applied[3] = -1e5 * data.qpos[3] - 200.0 * data.qvel[3]
        data.qfrc_applied[-6:] = 3000.0 * (reference - data.qpos[-6:]) - 5.0 * data.qvel[-6:]
        mujoco.mj_step(model, data)
        if i == 2999:
            before = data.geom_xpos[feet].copy()
    speed = (data.geom_xpos[feet] - before)[:, 0] / 0.5
    contacts = data.contact[: data.ncon]  # a foot that slides may be 0.1 mm above the ground for a moment
    depth = [-min((c.dist for c in contacts if foot in c.geom), default=0.0) for foot in feet]
    return speed, np.array(depth)


def test_feet_hold_below_the_friction_limit():
    speed, depth = pulled(0.9)
    assert np.abs(speed).max() < 1e-4
    assert depth.max() < 5e-5


def test_feet_slide_above_it():
    speed, _ = pulled(1.1)
    assert speed.min() == pytest.approx(speed.max(), rel=0.5)
    assert speed.min() > 0.1


def test_a_foot_that_creeps_is_held_as_one_at_rest():
    """A speed of 0.1 mm/s along the ground is braked like one of 1 mm/s: the solver converges."""
    start = stance.initial(ROBOT, StanceConfig())
    model = build(ROBOT, start, TerrainConfig(), PlanarizerConfig(), 3000.0)
    data = mujoco.MjData(model)
    data.qpos[:] = initial_qpos(model, ROBOT, start)
    reference = data.qpos[-6:].copy()

    def step():
        data.qfrc_applied[3] = -1e5 * data.qpos[3] - 200.0 * data.qvel[3]
        data.qfrc_applied[-6:] = 3000.0 * (reference - data.qpos[-6:]) - 5.0 * data.qvel[-6:]
        mujoco.mj_step(model, data)

    for _ in range(3000):
        step()
    settled = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, settled, mujoco.mjtState.mjSTATE_INTEGRATION)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_forward(model, data)
    foot = model.geom(ROBOT.feet[1].name)
    mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[foot.id], model.geom_bodyid[foot.id])
    left = []
    for speed in (0.0, 1e-4, 1e-3):
        mujoco.mj_setState(model, data, settled, mujoco.mjtState.mjSTATE_INTEGRATION)
        data.qvel += np.linalg.pinv(jacobian) @ [0.0, speed, 0.0]
        for _ in range(4):
            step()
        left.append(jacobian[1] @ data.qvel)
    slow, fast = (left[1] - left[0]) / 1e-4, (left[2] - left[0]) / 1e-3
    assert slow == pytest.approx(fast, abs=0.01)
    assert abs(slow) < 0.6
