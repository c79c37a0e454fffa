"""Off-screen pictures, and the sentence where there is no OpenGL."""

import mujoco
import numpy as np
import pytest

from plant import stance
from plant.config import PlanarizerConfig, StanceConfig, TerrainConfig
from plant.model import build, initial_qpos
from plant.render import RenderError, frames
from robots import description


def scene():
    robot = description.load("hume")
    start = stance.initial(robot, StanceConfig())
    model = build(robot, start, TerrainConfig(), PlanarizerConfig(), 3000.0)
    return model, initial_qpos(model, robot, start)


def test_missing_opengl_is_one_sentence(monkeypatch):
    def refuse(*_):
        raise RuntimeError("no display\nand much more")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    model, qpos = scene()
    with pytest.raises(RenderError, match="libegl1") as caught:
        next(frames(model, [qpos]))
    assert "\n" not in str(caught.value)


def test_a_moved_robot_gives_another_picture():
    model, qpos = scene()
    moved = qpos.copy()
    moved[1] += 0.1
    first, second = frames(model, [qpos, moved], width=64, height=48)
    assert first.shape == (48, 64, 3) and first.dtype == np.uint8
    assert (first != second).any()
