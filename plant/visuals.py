"""What the scene looks like: light, camera, ground, panels, and shapes for the links. None of it has mass."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from plant.stance import Array, Stance
from robots.description import Joint, MotionCapture, Robot
from robots.terrain import Block

CAMERA = "side"

_RIGHT = [0.85, 0.33, 0.16, 1.0]
_LEFT = [0.16, 0.42, 0.72, 1.0]
_SHELL = [0.82, 0.83, 0.85, 1.0]
_DARK = [0.20, 0.21, 0.23, 1.0]
_WOOD = [0.80, 0.62, 0.40, 1.0]
_LED = [1.0, 0.05, 0.05, 1.0]


def _show(body: Any, kind: Any, size: list[float], rgba: list[float], **place: Any) -> Any:
    return body.add_geom(
        type=kind, size=[*size, 0.0, 0.0, 0.0][:3], rgba=rgba, contype=0, conaffinity=0, group=1, mass=0.0,
        **place,
    )  # fmt: skip


def _capsule(body: Any, start: Array, end: Array, radius: float, rgba: list[float]) -> None:
    if np.linalg.norm(end - start) > 1e-3:
        _show(body, mujoco.mjtGeom.mjGEOM_CAPSULE, [radius], rgba, fromto=[*start, *end])


def scene(spec: mujoco.MjSpec, stance: Stance) -> None:
    """Light, sky, materials, and the camera that frames the robot from its right side."""
    head = spec.visual.headlight
    head.ambient = np.full(3, 0.35)
    head.diffuse = np.full(3, 0.35)
    head.specular = np.full(3, 0.1)
    spec.visual.quality.shadowsize = 4096
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.stat.extent = 1.5
    spec.stat.center = np.array([0.0, 0.0, 0.6])
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.98], rgb2=[0.62, 0.70, 0.80], width=256, height=256,
    )  # fmt: skip
    spec.add_texture(
        name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.78, 0.79, 0.80], rgb2=[0.70, 0.71, 0.73], width=256, height=256,
    )  # fmt: skip
    tiles = spec.add_material(name="tiles", texrepeat=[2.0, 2.0], texuniform=True, reflectance=0.05)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    spec.worldbody.add_light(
        name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[1.0, -2.0, 4.0], dir=[-0.3, 0.5, -1.0],
        diffuse=[0.6, 0.6, 0.58], castshadow=True,
    )  # fmt: skip
    centre = np.array([0.0, 0.0, 0.55 * float(stance.torso[2]) + 0.1])
    view = np.array([0.55, -2.35, 0.55])
    _camera(spec, CAMERA, centre + view, centre)


def _camera(spec: mujoco.MjSpec, name: str, position: Array, target: Array) -> None:
    backwards = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], backwards)
    right /= np.linalg.norm(right)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.column_stack([right, np.cross(backwards, right), backwards]).ravel())
    spec.worldbody.add_camera(name=name, pos=list(position), quat=list(quat), fovy=38.0)


def floor(spec: mujoco.MjSpec, height: float) -> Any:
    """The floor, a plane at ``height`` [m]."""
    return spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.5], pos=[0.0, 0.0, height],
        material="tiles",
    )  # fmt: skip


def block(spec: mujoco.MjSpec, number: int, block: Block, floor: float) -> Any:
    """A wooden block on the ``floor`` [m]."""
    size = [0.5 * (block.end - block.start), 0.45, 0.5 * block.height]
    return spec.worldbody.add_geom(
        name=f"block_{number}", type=mujoco.mjtGeom.mjGEOM_BOX, size=size,
        pos=[0.5 * (block.start + block.end), 0.0, floor + 0.5 * block.height], rgba=_WOOD,
    )  # fmt: skip


def panel(spec: mujoco.MjSpec, name: str, point: Array, normal: Array, edge: float) -> Any:
    """A wooden panel: upper face through ``point`` with ``normal``, lower edge at x = ``edge`` [m]."""
    thickness, width, beyond = 0.018, 0.45, 0.32
    down = float(np.sign(edge - point[0]))
    slope = np.array([down * normal[2], 0.0, -down * normal[0]])  # along the panel towards its lower edge
    below = min(abs(edge - point[0]) / normal[2], 1.0)
    centre = point + 0.5 * (below - beyond) * slope - thickness * normal
    centre[1] = 0.0
    tilt = float(np.arctan2(normal[0], normal[2]))  # about y
    return spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5 * (below + beyond), width, thickness],
        pos=list(centre), quat=[np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0], rgba=_WOOD,
    )  # fmt: skip


def torso(body: Any, robot: Robot) -> None:
    """Trunk and pelvis."""
    box = mujoco.mjtGeom.mjGEOM_BOX
    top = 2.0 * robot.base.com[2]
    hips = [np.asarray(j.position) for j in robot.joints if j.parent == robot.base.name]
    _capsule(body, hips[0], hips[-1], 0.035, _DARK)
    _show(body, box, [0.075, 0.12, 0.5 * top], _SHELL, pos=[0.0, 0.0, 0.5 * top + 0.02])


def link(body: Any, robot: Robot, joint: Joint) -> None:
    """The link behind ``joint``: a capsule to each child joint or foot, and the actuator's housing."""
    colour = _RIGHT if joint.name.startswith("right") else _LEFT
    ends = [child.position for child in robot.joints if child.parent == joint.name]
    ends += [foot.position for foot in robot.feet if foot.joint == joint.name]
    for end in ends:
        _capsule(body, np.zeros(3), np.asarray(end), 0.03, colour)


def led_site(name: str) -> str:
    """Of the site that is the LED ``name``."""
    return f"led.{name}"


def tube_name(joint: str) -> str:
    """Of the body that carries what is fixed to the shank behind ``joint``, if it bends."""
    return f"{joint}_tube"


def leds(spec: mujoco.MjSpec, system: MotionCapture) -> None:
    """The motion capture's LEDs on their links."""
    for led in system.leds:
        carrier = spec.body(tube_name(led.link)) or spec.body(led.link)
        carrier.add_site(name=led_site(led.name), pos=list(led.position), size=[0.012] * 3, rgba=_LED)
