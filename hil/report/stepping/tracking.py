"""How well the drives' torques follow in each state of a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.analysis.steps import PHASES, Step
from hil.record.signals import Signals
from hil.report.drawing import new_figure


def tracking(controller: Signals, steps: Sequence[Step]) -> dict[str, np.ndarray]:
    """For each foot that swings: rms of commanded less sensed torque, (joints, PHASES), N m; NaN where it never was."""
    error = controller.group("torque_command") - controller.group("torque_sensed")
    found = {}
    for foot in sorted({step.swing for step in steps}, reverse=True):
        squares: list[list[np.ndarray]] = [[np.empty((0, error.shape[1]))] for _ in PHASES]
        for step in (step for step in steps if step.swing == foot):
            bounds = [*step.began.values(), step.end]
            for state, begin, end in zip(step.began, bounds, bounds[1:], strict=False):
                squares[PHASES.index(state)].append(np.square(error[begin:end]))
        found[foot] = np.array([_root_mean(np.concatenate(rows)) for rows in squares]).T
    return found


def _root_mean(squares: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(squares, axis=0)) if len(squares) else np.full(squares.shape[1], np.nan)


def draw_tracking(controller: Signals, steps: Sequence[Step]) -> tuple[str, str, Any]:
    """A table by joint and state for either foot in swing; the darker, the further off."""
    joints, found = controller.members("torque_command"), tracking(controller, steps)
    figure, grid = new_figure(1, len(found), height=0.42 * len(joints) + 1.6)
    top = max(float(np.nanmax(values)) for values in found.values())
    for axes, (foot, values) in zip(np.ravel(grid), found.items(), strict=True):
        shown = axes.imshow(values, cmap="Blues", vmin=0.0, vmax=top, aspect="auto")
        axes.grid(visible=False)
        axes.set_xticks(range(len(PHASES)), [state.name.lower() for state in PHASES], fontsize=8)
        axes.set_yticks(range(len(joints)), [joint.replace("_", " ") for joint in joints], fontsize=8)
        axes.set_title(f"{foot.replace('_', ' ')} swings", fontsize=10)
        for (row, column), value in np.ndenumerate(values):
            colour = "white" if value > 0.6 * top else "black"
            axes.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=8, color=colour)
    figure.colorbar(shown, ax=grid, label="rms [N m]")
    caption = "Root mean square of commanded less sensed torque [N m], by joint and state, over all steps."
    return "Torque tracking by state", caption, figure
