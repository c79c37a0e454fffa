"""Pictures of the robot without a screen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np

_LEASH = 0.15  # m, that the robot may go before the camera goes with it
_MARK = (0.035, 0.002)  # m, radius and half height of a mark on the ground
_MARK_RGBA = (0.16, 0.60, 0.24, 0.85)

Mark = Sequence[float] | np.ndarray  # x, y, z of a place on the ground, m


class RenderError(RuntimeError):
    """No off-screen OpenGL here."""


def frames(
    model: mujoco.MjModel,
    qpos_rows: Iterable[np.ndarray],
    width: int = 960,
    height: int = 540,
    marks: Iterable[Sequence[Mark]] | None = None,
) -> Iterator[np.ndarray]:
    """RGB pictures (height, width, 3) uint8 of the robot at each row of generalised coordinates; the camera goes
    with it when it walks away. ``marks``: places to show as discs in each picture.

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
    start: np.ndarray | None = None
    of_picture = iter(marks) if marks is not None else None
    with renderer:
        for qpos in qpos_rows:
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
            centre = data.subtree_com[0].copy()
            start = centre if start is None else start
            if model.ncam:
                data.cam_xpos[0] = model.cam_pos[0] + _followed(centre - start)
            renderer.update_scene(data, camera)
            for mark in next(of_picture, ()) if of_picture is not None else ():
                _disc(renderer.scene, mark)
            yield renderer.render()


def _followed(way: np.ndarray) -> np.ndarray:
    """How far the camera goes when the robot has gone ``way`` (3,) [m]: horizontally, what is beyond its leash."""
    way = np.array([way[0], way[1], 0.0])
    distance = float(np.linalg.norm(way))
    return way * max(0.0, 1.0 - _LEASH / distance) if distance > 0.0 else way


def _disc(scene: mujoco.MjvScene, place: Mark) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    radius, half = _MARK
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([radius, half, 0.0]),
        np.asarray(place, dtype=float), np.eye(3).ravel(), np.array(_MARK_RGBA, dtype=np.float32),
    )  # fmt: skip
    scene.ngeom += 1
