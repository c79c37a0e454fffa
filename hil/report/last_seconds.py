"""The end of a run that failed, at every physics step: forces at the feet, torques, currents with their limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import UserError
from hil.record.ring import CHANNEL, LAST_SECONDS_FILE
from hil.record.signals import Signals
from hil.report.drawing import LIMIT, Plot, encoded, new_figure
from robots.description import Robot

_SHOWN_S = 1.0  # of the end: at 3 kHz more of it is a blot
_AXES = {"x": "tab:blue", "y": "tab:green", "z": "tab:red"}


def draw_last_seconds(directory: Path, tables: Mapping[str, Signals], robot: Robot) -> list[Plot]:
    """The plots, from the file in ``directory``; none if the run has none. ``tables``: of the run, for what was
    commanded and sensed."""
    if not (directory / LAST_SECONDS_FILE).exists():
        return []
    try:
        steps = Signals.load(directory, CHANNEL, LAST_SECONDS_FILE)
    except UserError:  # a damaged file does not keep a report from being written; its link stays
        return []
    if not len(steps):
        return []
    rows = steps.seconds >= steps.seconds[-1] - _SHOWN_S
    steps = Signals(steps.times[rows], steps.names, steps.data[rows])
    controller = tables["controller"]
    late = controller.times >= steps.times[0]
    controller = Signals(controller.times[late], controller.names, controller.data[late])
    return [
        _feet(steps, [foot.name for foot in robot.feet]),
        _torques(steps, controller, robot.joint_names),
        _currents(steps, robot),
    ]


def _feet(steps: Signals, feet: Sequence[str]) -> Plot:
    figure, grid = new_figure(1, max(len(feet), 1), height=3.2)
    for axes, foot in zip(np.ravel(grid), feet, strict=False):
        for axis, colour in _AXES.items():
            axes.plot(steps.seconds, steps[f"contact.{foot}.{axis}"], color=colour, linewidth=0.8, label=axis)
        axes.set(xlabel="t [s]", ylabel="force [N]", title=foot.replace("_", " "))
        axes.title.set_fontsize(10)
        axes.margins(x=0.0)
    np.ravel(grid)[0].legend(fontsize=8, ncols=3)
    caption = "Of the robot on the ground, every physics step; a foot that presses down has a negative z."
    return Plot("Last second: forces at the feet", caption, encoded(figure))


def _by_joint(joints: Sequence[str]) -> tuple[Any, list[Any]]:
    rows = max(-(-len(joints) // 3), 1)
    figure, grid = new_figure(rows, 3, height=2.4 * rows)
    every = list(np.ravel(grid))
    for axes, joint in zip(every, joints, strict=False):
        axes.set_title(joint.replace("_", " "), fontsize=10)
        axes.set_xlabel("t [s]")
        axes.margins(x=0.0)
    for axes in every[len(joints) :]:
        axes.set_visible(False)
    return figure, every


def _torques(steps: Signals, controller: Signals, joints: Sequence[str]) -> Plot:
    figure, grid = _by_joint(joints)
    for axes, joint in zip(grid, joints, strict=False):

        def sampled(what: str, label: str, axes: Any = axes, joint: str = joint, **style: Any) -> None:
            if f"{what}.{joint}" in controller:
                axes.step(controller.seconds, controller[f"{what}.{joint}"], where="post", label=label, **style)

        sampled("torque_command", "commanded", color="0.7", linewidth=0.8)
        axes.plot(steps.seconds, steps[f"torque.{joint}"], color="tab:orange", linewidth=1.6, label="true")
        sampled("torque_sensed", "sensed", color="tab:blue", linewidth=0.7)
        axes.set_ylabel("torque [N m]")
    grid[0].legend(fontsize=8)
    caption = "True: every physics step. Commanded and sensed: as the controller sent and saw them, at its rate."
    return Plot("Last second: joint torques", caption, encoded(figure))


def _currents(steps: Signals, robot: Robot) -> Plot:
    figure, grid = _by_joint(robot.joint_names)
    for axes, joint in zip(grid, robot.joints, strict=False):
        demand, limit = steps[f"demand.{joint.name}"], joint.actuator.current_limit
        name = f"actuator.current.{joint.name}"
        if name in steps:
            axes.plot(steps.seconds, steps[name], color="tab:orange", linewidth=1.4, label="current")
        axes.step(steps.seconds, demand, where="post", color="tab:blue", linewidth=0.5, label="demand")
        for sign in (1.0, -1.0):
            axes.axhline(sign * limit, **LIMIT, label="limit" if sign > 0 else None)
        axes.set_ylabel("current [A]")
    grid[0].legend(fontsize=8)
    caption = "What each drive asks of its current loop, what flows, and the drive's limits; every physics step."
    return Plot("Last second: currents", caption, encoded(figure))
