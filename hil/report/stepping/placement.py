"""Where the feet landed: errors against the plan, and their way over the ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator

from central_controller.behaviours.step import State
from hil.analysis.steps import Step
from hil.record.signals import Signals
from hil.report.drawing import draw_line, new_figure

_NUMBERED = 40  # steps; numbers of more would cover their feet
_COLOURS = ("tab:blue", "tab:orange")


def draw_errors(steps: Sequence[Step]) -> tuple[str, str, Any]:
    """Landed less planned, seen from the stance foot, with the ellipse of the root mean squares; and step by step."""
    figure, (scatter, course) = new_figure(1, 2, height=3.8)
    errors = np.array([100.0 * step.error for step in steps])
    for foot, colour in zip(sorted({step.swing for step in steps}), _COLOURS, strict=False):
        own = [n for n, step in enumerate(steps) if step.swing == foot]
        label = foot.replace("_", " ")
        scatter.plot(*errors[own].T, "o", color=colour, markersize=4, label=label)
        course.plot([steps[n].number for n in own], np.hypot(*errors[own].T), "o", color=colour, label=label)
    known = errors[np.isfinite(errors).all(axis=1)]
    if len(known):
        about_plan = known.T @ known / len(known)
        rms = float(np.sqrt(np.trace(about_plan)))
        scatter.add_patch(_ellipse(about_plan))
        scatter.plot(
            *known.mean(axis=0), "k+", markersize=9, label="mean ({:.2f}, {:.2f}) cm".format(*known.mean(axis=0))
        )
        course.axhline(rms, color="k", linestyle="--", linewidth=1.0, label=f"rms {rms:.2f} cm")
    reach = 1.15 * np.nanmax(np.abs(errors), initial=0.5)
    scatter.set(xlabel="error in x [cm]", ylabel="error in y [cm]", xlim=(-reach, reach), ylim=(-reach, reach))
    scatter.set_aspect("equal")
    scatter.axhline(0.0, color="0.8", linewidth=0.7, zorder=0)
    scatter.axvline(0.0, color="0.8", linewidth=0.7, zorder=0)
    course.set(xlabel="step", ylabel="distance from the plan [cm]")
    course.set_ylim(bottom=0.0)
    course.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (scatter, course):
        axes.legend(fontsize=8)
    caption = (
        "True place 10 ms after touch-down less the planned one, from the stance foot. Ellipse: rms about the plan."
    )
    return "Foot placement errors", caption, figure


def _ellipse(moment: np.ndarray) -> Ellipse:
    """x such that xᵀ ``moment``⁻¹ x = 1, (2, 2)."""
    sizes, axes = np.linalg.eigh(moment)
    angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
    width, height = 2.0 * np.sqrt(np.maximum(sizes[::-1], 0.0))
    return Ellipse((0.0, 0.0), width, height, angle=angle, fill=False, color="k", linewidth=1.1)


def draw_paths(controller: Signals, world: Signals, steps: Sequence[Step]) -> tuple[str, str, Any]:
    """The true ways of feet and centre of mass from above."""
    figure, axes = new_figure(height=5.0)
    first, last = steps[0].began[State.UNLOADING], min(steps[-1].end, len(controller)) - 1
    rows = slice(*world.latest_before(controller.times[[first, last]]))
    draw_line(axes, world["com.x"][rows], world["com.y"][rows], color="0.6", label="centre of mass")
    for foot, colour in zip(sorted({step.swing for step in steps}), _COLOURS, strict=False):
        name = foot.replace("_", " ")
        draw_line(
            axes, world[f"foot.{foot}.x"][rows], world[f"foot.{foot}.y"][rows], color=colour, linewidth=0.8, label=name
        )
        own = [step for step in steps if step.swing == foot]
        stood = np.array([_stance_place(controller, world, step) for step in own])
        planned, landed = stood + [step.planned for step in own], stood + [step.landed for step in own]
        axes.plot(*planned.T, "o", markerfacecolor="none", color="k", markersize=8, label=f"{name}, planned")
        axes.plot(*landed.T, "x", color=colour, markersize=7, label=f"{name}, landed")
        for step, place in zip(own, landed, strict=True) if len(steps) <= _NUMBERED else ():
            axes.annotate(str(step.number), place, (5, 4), textcoords="offset points", fontsize=7, color=colour)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=8, ncols=2)
    caption = (
        "As the physics has them; planned places are drawn from where the stance foot truly stood. Numbers: steps."
    )
    return "Ways of the feet from above", caption, figure


def _stance_place(controller: Signals, world: Signals, step: Step) -> np.ndarray:
    touch = step.began[State.LOADING]
    row = world.latest_before(controller.times[touch : touch + 1])[0]
    return np.array([world[f"foot.{step.stance}.{axis}"][row] for axis in "xy"])
