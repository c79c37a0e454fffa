"""Pictures of the robot without a screen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import mujoco
import numpy as np


class RenderError(RuntimeError):
    """No off-screen OpenGL here."""


def frames(
    model: mujoco.MjModel, qpos_rows: Iterable[np.ndarray], width: int = 960, height: int = 540
) -> Iterator[np.ndarray]:
    """RGB pictures (height, width, 3) uint8 of the robot at each row of generalised coordinates.

    Raises RenderError where there is no off-screen OpenGL.
    """
    screen = model.vis.global_
    screen.offwidth, screen.offheight = max(screen.offwidth, width), max(screen.offheight, height)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise RenderError(
            f"no off-screen OpenGL ({reason}); on Debian: apt-get install libegl1 libgl1-mesa-dri"
        ) from None
    data = mujoco.MjData(model)
    camera = 0 if model.ncam else -1
    with renderer:
        for qpos in qpos_rows:
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            yield renderer.render()
