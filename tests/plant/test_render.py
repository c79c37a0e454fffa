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


def test_marks_are_seen_each_in_its_picture():
    model, qpos = scene()
    plain, marked = frames(model, [qpos, qpos], 128, 96, marks=[[], [(0.0, -0.5, 0.0)]])
    changed = (plain.astype(int) != marked).any(axis=2)
    assert 5 < changed.sum() < 600
    red, green, blue = marked[changed].astype(int).T
    assert (green - np.maximum(red, blue)).max() > 60


def test_the_camera_goes_with_a_robot_that_walks_away_but_not_with_one_that_sways():
    model, qpos = scene()
    away, sway = qpos.copy(), qpos.copy()
    away[0] += 3.0
    sway[0] += 0.05

    def column(picture: np.ndarray) -> float:
        """Where the orange of the right leg is, of the width."""
        red, blue = picture[..., 0].astype(int), picture[..., 2].astype(int)
        return float(np.flatnonzero((red - blue > 60).any(axis=0)).mean()) / picture.shape[1]

    first, swayed, far = (column(p) for p in frames(model, [qpos, sway, away], 160, 90))
    assert swayed > first + 0.01
    assert far == pytest.approx(first + 0.15 * (swayed - first) / 0.05, abs=0.02)
