"""How long the states of each step took, beside what they were configured to take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from central_controller.behaviours.step import State
from hil.analysis.steps import PHASES, Step
from hil.record.signals import Signals
from hil.report.drawing import LIMIT, new_figure

_KEYS = {
    State.UNLOADING: "transition", State.LIFTING: "lifting", State.LANDING: "landing", State.LOADING: "loading",
    State.DOUBLE: "dual_support",
}  # fmt: skip
_COLOURS = ("tab:blue", "tab:orange")


def draw_timing(configuration: Mapping[str, Any], controller: Signals, steps: Sequence[Step]) -> tuple[str, str, Any]:
    """One panel per state, and one of the whole step."""
    timing = configuration["controller"]["stepping"]["timing"]
    figure, grid = new_figure(2, 3, height=4.6)
    taken = [step.durations(controller.seconds) for step in steps]
    numbers = np.array([step.number for step in steps])
    extension = np.array([0.0 if s.planned_at is None else controller["plan.extension"][s.planned_at] for s in steps])
    sides = {foot: n for n, foot in enumerate(sorted({step.swing for step in steps}))}
    side = np.array([sides[step.swing] for step in steps])
    for axes, state in zip(np.ravel(grid), PHASES, strict=False):
        found = np.array([durations.get(state, np.nan) for durations in taken])
        expected = timing[_KEYS[state]] + (extension if state is State.LANDING else 0.0 * extension)
        _panel(axes, numbers, found, expected, side, list(sides))
        axes.set_title(f"{state.name}: timing.{_KEYS[state]}", fontsize=9)
    whole = np.array([sum(d.values()) if len(d) == len(PHASES) else np.nan for d in taken])
    _panel(grid[-1, -1], numbers, whole, sum(timing[key] for key in _KEYS.values()) + extension, side, list(sides))
    grid[-1, -1].set_title("whole step", fontsize=9)
    grid[0, 0].legend(fontsize=7)
    caption = "LANDING ends when the ground is felt; what the planner put it off by counts as configured."
    return "Timing of the steps", caption, figure


def _panel(
    axes: Any, numbers: np.ndarray, found: np.ndarray, expected: np.ndarray, side: np.ndarray, feet: Sequence[str]
) -> None:
    axes.plot(numbers, 1e3 * expected, drawstyle="steps-mid", **LIMIT, label="configured")
    for n, foot in enumerate(feet):
        own = side == n
        axes.plot(
            numbers[own], 1e3 * found[own], "o", markersize=3.5, color=_COLOURS[n % 2], label=foot.replace("_", " ")
        )
    axes.set(xlabel="step", ylabel="duration [ms]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    top = 1e3 * np.nanmax([*found, *expected])
    axes.set_ylim(0.0, 1.15 * top)
