"""A recorded run as a recording of Rerun: signals over simulated time, the robot as it moved, its feet's forces.

Paths: ``/CHANNEL/WHAT/OF`` for signals (``/controller/torque_sensed/left_knee``), ``/world3d/robot/BODY`` for bodies,
``/world3d/forces/FOOT`` for forces, ``/events`` for injections and what came first. Needs rerun-sdk.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hil.record.recorded import Recorded
from hil.record.signals import Signals
from hil.report.scene import scene_of

TIMELINE = "simulation_time"
FPS = 60
METRES_PER_NEWTON = 2e-3  # of the arrows
_PLANE = 1.0  # m, half of what is drawn of one that has no end


def write_rerun(path: Path, run: Recorded) -> None:
    """Write ``run`` to ``path``."""
    recording = rr.RecordingStream("hume-hil", recording_id=f"{run.directory.resolve()}", send_properties=False)
    recording.save(path, default_blueprint=_views(run))
    for channel, table in run.tables.items():
        _signals(recording, channel, table)
    if len(run.tables["world"]):
        _robot(recording, run)
    _events(recording, run)
    recording.flush()
    recording.disconnect()


def signal_path(channel: str, signal: str) -> str:
    """``torque_sensed.left_knee`` of ``controller``: ``/controller/torque_sensed/left_knee``."""
    return f"/{channel}/{signal.replace('.', '/')}"


def _times(seconds: np.ndarray) -> list[Any]:
    return [rr.TimeColumn(TIMELINE, duration=seconds)]


def _signals(recording: Any, channel: str, table: Signals) -> None:
    for column, name in enumerate(table.names):
        values = table.data[:, column]
        known = np.isfinite(values)
        if known.any() and not name.startswith("qpos."):
            scalars = rr.Scalars.columns(scalars=values[known])
            recording.send_columns(signal_path(channel, name), _times(table.seconds[known]), scalars)


def _robot(recording: Any, run: Recorded) -> None:
    model, world = scene_of(run.scenario), run.tables["world"]
    data = mujoco.MjData(model)
    recording.log("/world3d", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for path, shape in _shapes(model):
        recording.log(path, shape, static=True)
    ticks = np.arange(0.0, world.seconds[-1] + 1e-9, 1.0 / FPS)
    rows = np.searchsorted(world.seconds, ticks).clip(max=len(world) - 1)
    qpos = world.group("qpos")[rows]
    moving = [body for body in range(1, model.nbody) if _shown(model, body)]
    places = np.empty((len(rows), model.nbody, 3))
    turns = np.empty((len(rows), model.nbody, 4))
    for n, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        places[n], turns[n] = data.xpos, data.xquat
    times = _times(world.seconds[rows])
    for body in moving:
        transform = rr.Transform3D.columns(
            translation=places[:, body], quaternion=_xyzw(turns[:, body])
        )  # fmt: skip
        recording.send_columns(_body_path(model, body), times, transform)
    for foot in [name[:-2] for name in world.members("foot") if name.endswith(".x")]:
        forces = -world.group(f"contact.{foot}")[rows]  # of the ground on the foot: they point to where one sees them
        arrows = rr.Arrows3D.columns(origins=world.group(f"foot.{foot}")[rows], vectors=METRES_PER_NEWTON * forces)
        look = rr.Arrows3D.from_fields(colors=[[40, 160, 60]], radii=[0.008])
        recording.log(f"/world3d/forces/{foot}", look, static=True)
        recording.send_columns(f"/world3d/forces/{foot}", times, arrows)
    com = rr.Points3D.columns(positions=world.group("com")[rows])
    recording.log("/world3d/com", rr.Points3D.from_fields(radii=[0.02], colors=[[230, 190, 30]]), static=True)
    recording.send_columns("/world3d/com", times, com)


def _xyzw(quaternions: np.ndarray) -> np.ndarray:
    """MuJoCo's (w, x, y, z), (..., 4), as Rerun has them."""
    return np.roll(quaternions, -1, axis=-1)


def _body_path(model: Any, body: int) -> str:
    return "/world3d/terrain" if body == 0 else f"/world3d/robot/{model.body(body).name}"


def _shown(model: Any, body: int) -> list[int]:
    """Geoms of a body that a picture shows."""
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
    return [g for g in geoms if model.geom_group[g] < 3 and model.geom_rgba[g][3] > 0]


def _shapes(model: Any) -> Iterator[tuple[str, Any]]:
    """Every geom that a picture shows, in its body's frame."""
    kind = mujoco.mjtGeom
    for body in range(model.nbody):
        for number, geom in enumerate(_shown(model, body)):
            size, position = model.geom_size[geom], model.geom_pos[geom]
            turn = model.geom_quat[geom]
            place = {"quaternions": [_xyzw(turn)], "colors": [_colour(model, geom)], "fill_mode": "solid"}
            axis = np.empty(3)
            mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), turn)
            match model.geom_type[geom]:
                case kind.mjGEOM_CAPSULE:  # Rerun's begins at the centre of one of its caps
                    start = position - size[1] * axis
                    shape: Any = rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=[start], **place)
                case kind.mjGEOM_CYLINDER:
                    shape = rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], centers=[position], **place)
                case kind.mjGEOM_SPHERE:
                    shape = rr.Ellipsoids3D(half_sizes=[[size[0]] * 3], centers=[position], **place)
                case kind.mjGEOM_ELLIPSOID:
                    shape = rr.Ellipsoids3D(half_sizes=[size], centers=[position], **place)
                case kind.mjGEOM_BOX:
                    shape = rr.Boxes3D(half_sizes=[size], centers=[position], **place)
                case kind.mjGEOM_PLANE:
                    half = [min(s, _PLANE) or _PLANE for s in size[:2]]
                    shape = rr.Boxes3D(half_sizes=[[*half, 1e-3]], centers=[position - 1e-3 * axis], **place)
                case _:
                    continue
            yield f"{_body_path(model, body)}/{number}", shape


def _colour(model: Any, geom: int) -> list[int]:
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else np.array([0.74, 0.75, 0.76, 1.0])
    return [round(255 * float(part)) for part in rgba]


def _events(recording: Any, run: Recorded) -> None:
    events = [(i["time_s"], "INFO", f"{i['key']} = {i['value']}") for i in run.injected]
    signs = run.record.get("came_first", []) if run.record is not None else []
    events += [(s["time"], "WARN", f"{s['kind']}, {s['where']}: {s['sentence']}") for s in signs]
    events.append((run.end, "INFO" if run.verdict == "stable" else "ERROR", f"{run.verdict}: {run.reason}"))
    for time, level, text in sorted(events):
        recording.set_time(TIMELINE, duration=time)
        recording.log("/events", rr.TextLog(text, level=level))


def _views(run: Recorded) -> Any:
    """What the viewer shows at first."""
    force = ["/controller/internal_force", "/controller/internal_force_reference", "/world/internal_force"]
    plots = [
        rrb.TimeSeriesView(name="centre of mass [m]", origin="/controller/com"),
        rrb.TimeSeriesView(name="internal force [N]", contents=force),
        rrb.TimeSeriesView(name="torques, sensed [N m]", origin="/controller/torque_sensed"),
        rrb.TextLogView(name="events", origin="/events"),
    ]  # fmt: skip
    robot = rrb.Spatial3DView(name=f"{run.scenario.name}, seed {run.seed}", origin="/world3d")
    return rrb.Blueprint(
        rrb.Horizontal(robot, rrb.Vertical(*plots), column_shares=[3, 2]), rrb.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )  # fmt: skip
