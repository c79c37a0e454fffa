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
    data.qpos[:] = initial_qpos(model, start)
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
    depth = [-min(c.dist for c in data.contact[: data.ncon] if foot in c.geom) for foot in feet]
    return speed, np.array(depth)


def test_feet_hold_below_the_friction_limit():
    speed, depth = pulled(0.9)
    assert np.abs(speed).max() < 1e-4
    assert depth.max() < 5e-5


def test_feet_slide_above_it():
    speed, _ = pulled(1.1)
    assert speed.min() == pytest.approx(speed.max(), rel=0.5)
    assert speed.min() > 0.1
