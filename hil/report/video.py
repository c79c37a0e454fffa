"""The video of a run, rendered from its record."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from hil.errors import EmulationError
from hil.record.signals import Signals
from hil.report.html import VIDEO_FILE
from hil.report.scene import scene_of
from hil.scenario import Scenario
from robots import description

FPS = 30
_SIZE = (960, 544)


def require_rendering() -> None:
    """Raise EmulationError, before any work is done in vain, where there is no off-screen OpenGL."""
    import mujoco

    from plant.render import RenderError, frames

    try:
        for _ in frames(mujoco.MjModel.from_xml_string("<mujoco/>"), [np.empty(0)], 8, 8):
            pass
    except RenderError as error:
        raise EmulationError(f"no video: {error}") from None


def write_video(directory: Path, scenario: Scenario, tables: Mapping[str, Signals]) -> Path:
    """Encode ``video.mp4`` (H.264) of a run of ``scenario`` at the speed of simulated time. Places planned for the feet
    are shown from when they are planned until the next plan for the foot.

    ``tables``: its channels. Raises EmulationError without off-screen OpenGL.
    """
    from plant.render import RenderError, frames

    table = tables["world"]
    qpos = table.group("qpos")
    ticks = np.arange(0.0, table.seconds[-1], 1.0 / FPS)
    rows = qpos[np.searchsorted(table.seconds, ticks).clip(max=len(qpos) - 1)]
    radius = description.load(scenario.robot).foot_radius  # places are those of the feet's centres
    marks = [[place - [0.0, 0.0, radius] for place in places] for places in planned_places(tables, ticks)]
    path = directory / VIDEO_FILE
    width, height = _SIZE
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{width}x{height}", "-r", str(FPS), "-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p", str(path),
    ]  # fmt: skip
    try:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:
            assert encoder.stdin is not None and encoder.stderr is not None
            try:
                for picture in frames(scene_of(scenario), rows, width, height, marks):
                    encoder.stdin.write(picture.tobytes())
                encoder.stdin.close()
            except BrokenPipeError:  # its own words say why
                pass
            message = encoder.stderr.read().decode("utf-8", "replace").strip()
    except RenderError as error:
        path.unlink(missing_ok=True)
        raise EmulationError(f"no video: {error}") from None
    if encoder.returncode:
        raise EmulationError(f"no video: {message or 'the encoder failed'}")
    return path


def planned_places(tables: Mapping[str, Signals], seconds: np.ndarray) -> list[list[np.ndarray]]:
    """For each of ``seconds`` the places (3,) [m] of the feet's centres that are planned, or were last: in the world,
    from where the stance foot truly stood."""
    from hil.analysis.steps import steps_of

    controller, world = tables["controller"], tables["world"]
    places: list[list[np.ndarray]] = [[] for _ in seconds]
    planned: dict[str, list[tuple[float, np.ndarray]]] = {}
    for step in steps_of(controller, world):
        if step.planned_at is not None:
            row = world.latest_before(controller.times[step.planned_at : step.planned_at + 1])[0]
            stood = np.array([world[f"foot.{step.stance}.{axis}"][row] for axis in "xyz"])
            here = stood + np.append(step.planned, 0.0)
            planned.setdefault(step.swing, []).append((float(controller.seconds[step.planned_at]), here))
    for plans in planned.values():
        since = np.searchsorted([time for time, _ in plans], seconds, side="right")
        for tick, count in enumerate(since):
            if count:
                places[tick].append(plans[count - 1][1])
    return places
