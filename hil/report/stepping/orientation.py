"""How upright the torso stays while it steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from central_controller.behaviours.step import State
from hil.analysis.stepping import STEADY_FROM
from hil.analysis.steps import Step
from hil.record.signals import Signals
from hil.report.drawing import draw_limit, draw_line, new_figure

BOUND = 0.05  # rad: within which the source's robot stayed (Kim 2018 §7.3.2)


def draw_orientation(
    configuration: Mapping[str, Any], controller: Signals, world: Signals, steps: Sequence[Step]
) -> tuple[str, str, Any]:
    """Roll, pitch and yaw over time with the limits of the verdict and the source's bound."""
    figure, panels = new_figure(3, 1, height=5.4)
    limit = np.degrees(configuration["limits"]["orientation_error"])
    begin = controller.seconds[steps[0].began[State.UNLOADING]]
    shown = world.seconds >= begin - 0.2
    told = controller.seconds >= begin - 0.2
    for axes, name in zip(panels, ("roll", "pitch", "yaw"), strict=True):
        draw_line(
            axes, world.seconds[shown], np.degrees(world[f"base.{name}"][shown]), color="tab:orange", label="true"
        )
        angles = np.degrees(controller[name][told])
        draw_line(axes, controller.seconds[told], angles, color="tab:blue", linestyle="--", label="estimated")
        for step in steps:
            if (lift := step.began.get(State.LIFTING)) is not None:
                touch = controller.seconds[step.began[State.LOADING]]
                axes.axvspan(controller.seconds[lift], touch, color="0.95", zorder=0)
        if name != "yaw":
            for sign in (1.0, -1.0):
                bound = sign * np.degrees(BOUND)
                axes.axhline(
                    bound, color="tab:green", linewidth=1.0, label=f"source's bound {BOUND:g} rad" if sign > 0 else None
                )
                draw_limit(axes, sign * limit, "limit ±" if sign > 0 else "")
        if len(steps) > STEADY_FROM:
            axes.axvline(
                controller.seconds[steps[STEADY_FROM - 1].began[State.LOADING]], color="0.4", linestyle="--",
                linewidth=0.8, label="steady from here on",
            )  # fmt: skip
        axes.set(ylabel=f"{name} [°]", xlim=(begin - 0.2, float(world.seconds[-1])))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8)
    panels[-1].set_xlabel("t [s]")
    caption = "Grey: a foot is in the air. Yaw has no limit: point feet turn it in double support only."
    return "Orientation while stepping", caption, figure
