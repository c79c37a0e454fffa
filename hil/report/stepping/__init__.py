"""The plots that only a run of stepping has: where the feet went, when, and what the planner expected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hil.analysis.steps import steps_of
from hil.record.signals import Signals
from hil.report.drawing import Plot, encoded
from hil.report.stepping.orientation import draw_orientation
from hil.report.stepping.placement import draw_errors, draw_paths
from hil.report.stepping.portraits import draw_portraits
from hil.report.stepping.timing import draw_timing
from hil.report.stepping.tracking import draw_tracking

Figures = dict[str, tuple[str, str, Any]]  # title, caption, figure by the name of a file


def draw_stepping(record: Mapping[str, Any], tables: Mapping[str, Signals]) -> list[Plot]:
    """Plots for the page of a run; none if no foot has landed."""
    return [
        Plot(title, caption, encoded(figure))
        for title, caption, figure in figures(record["configuration"], tables).values()
    ]


def figures(configuration: Mapping[str, Any], tables: Mapping[str, Signals]) -> Figures:
    """The same as figures of matplotlib. ``configuration``: the scenario as run.json has it."""
    controller, world = tables["controller"], tables["world"]
    steps = steps_of(controller, world)
    if not steps:
        return {}
    return {
        "portraits": draw_portraits(configuration, controller, world, steps),
        "placement": draw_errors(steps),
        "paths": draw_paths(controller, world, steps),
        "timing": draw_timing(configuration, controller, steps),
        "orientation": draw_orientation(configuration, controller, world, steps),
        "tracking": draw_tracking(controller, steps),
    }
