"""Phase portraits of steps with what the planner predicted (Kim 2018 Fig. 7.15e)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from central_controller.behaviours.step import State
from central_controller.planning.height_surface import Plane
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from hil.analysis.steps import Step
from hil.record.signals import Signals
from robots import description

_SHOWN = 8  # of more steps the first and the last half of this
_COLUMNS = 4
_PREDICTION_STEP = 0.005  # s
# observed: before and after the switch, from one to the next; predicted: likewise
_TRUE: dict[str, Any] = {"color": "0.72", "linewidth": 2.4}
_BEFORE: dict[str, Any] = {"color": "tab:red", "linewidth": 0.8}
_AFTER: dict[str, Any] = {"color": "tab:green", "linewidth": 0.8}
_PREDICTED: dict[str, Any] = {"color": "k", "linewidth": 1.3}
_PREDICTED_AFTER: dict[str, Any] = {"color": "darkgreen", "linewidth": 1.5, "linestyle": ":"}


def draw_portraits(
    configuration: Mapping[str, Any], controller: Signals, world: Signals, steps: Sequence[Step]
) -> tuple[str, str, Any]:
    """Velocity over place in x and in y, one pair of axes per step, all from its stance foot."""
    chosen = shown(steps)
    rows = 2 * -(-len(chosen) // _COLUMNS)
    height = 2.05 * rows
    # placed by hand: the constrained layout takes seconds for so many axes
    margins = {"left": 0.075, "bottom": 0.45 / height, "right": 0.99, "top": 1.0 - 0.8 / height}
    figure, grid = plt.subplots(
        rows, _COLUMNS, figsize=(9, height), gridspec_kw={**margins, "wspace": 0.3, "hspace": 0.45}
    )
    for axes in np.ravel(grid):
        axes.set_visible(False)
        axes.grid(alpha=0.3)
    switches = {step.number: at for step, at in zip(steps, switch_rows(controller, steps), strict=True)}
    for at, step in enumerate(chosen):
        predicted = predictions(configuration, controller, step, switches)
        for axis in range(2):
            axes = grid[2 * (at // _COLUMNS) + axis, at % _COLUMNS]
            axes.set_visible(True)
            _portrait(axes, axis, controller, world, step, switches, predicted)
            if not axis:
                axes.set_title(f"step {step.number}: {step.swing.replace('_', ' ')} swings", fontsize=8)
            axes.set_xlabel(f"{'xy'[axis]} [m]", fontsize=8)
            if at % _COLUMNS == 0:
                axes.set_ylabel(f"velocity of {'xy'[axis]} [m/s]", fontsize=8)
            axes.tick_params(labelsize=7)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=4, fontsize=8)
    left = f" Of {len(steps)} steps the first and the last {_SHOWN // 2}." if len(chosen) < len(steps) else ""
    return (
        "Phase portraits of the steps",
        "The centre of mass about the stance foot (∗), x above y. It switches to the other foot half-way between "
        "touch-down and the next lift. Predicted from where the plan was made, at the end of the lift." + left,
        figure,
    )


def shown(steps: Sequence[Step]) -> list[Step]:
    """The steps that are drawn: all, or the first and the last ones."""
    if len(steps) <= _SHOWN:
        return list(steps)
    return [*steps[: _SHOWN // 2], *steps[-_SHOWN // 2 :]]


def switch_rows(controller: Signals, steps: Sequence[Step]) -> list[int]:
    """The row of each step in which the stance foot changes: half-way between touch-down and the next lift, as the
    planner has it; half-way to where the record ends if that comes before."""
    lifts = [step.began.get(State.LIFTING, step.began[State.UNLOADING]) for step in steps[1:]]
    lifts.append(min(steps[-1].end, len(controller) - 1))
    times = controller.times
    middles = [(times[s.began[State.LOADING]] + times[lift]) // 2 for s, lift in zip(steps, lifts, strict=True)]
    return [int(row) for row in controller.latest_before(np.array(middles))]


def predictions(
    configuration: Mapping[str, Any], controller: Signals, step: Step, switches: Mapping[int, int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """What the plan of ``step`` expected before and after the switch: rows t, x, y, vx, vy in the controller's
    coordinates, NaN in y where a planarizer holds it. None without a plan that predicts."""
    row, stepping = step.planned_at, configuration["controller"]["stepping"]
    if row is None or stepping["placement"] == "fixed":
        return None

    def value(*names: str) -> list[float]:
        return [float(controller[name][row]) for name in names]

    robot = description.load(configuration["robot"])
    (height,) = value("com_reference.z")
    pendulum = Pendulum(Plane(height), robot.gravity, robot.mass / (robot.mass + stepping["slider_mass"]))
    stance = Foot(*value(*(f"foot.{step.stance}.{axis}" for axis in "xyz")))
    now = PendulumState(*value("pendulum.x", "pendulum.y", "pendulum.vx", "pendulum.vy"))
    (remaining,) = value("plan.remaining")
    switching = PendulumState(*value("plan.x", "plan.y", "plan.vx", "plan.vy"))
    x, y = value("plan.foot.x", "plan.foot.y")
    before = pendulum.path(now, stance, remaining, _PREDICTION_STEP)
    after = pendulum.path(switching, Foot(x, y, stance.z), _until(controller, step, switches), _PREDICTION_STEP)
    if not stepping["planner"]["lateral"]:
        before[:, [2, 4]] = after[:, [2, 4]] = np.nan
    return before, after


def _until(controller: Signals, step: Step, switches: Mapping[int, int]) -> float:
    """Time [s] from the switch of ``step`` to the next one."""
    here, seconds = switches[step.number], controller.seconds
    return max(float(seconds[switches.get(step.number + 1, min(step.end, len(seconds) - 1))] - seconds[here]), 0.05)


def _portrait(
    axes: Any, axis: int, controller: Signals, world: Signals, step: Step, switches: Mapping[int, int],
    predicted: tuple[np.ndarray, np.ndarray] | None,
) -> None:  # fmt: skip
    name = "xy"[axis]
    begin = switches.get(step.number - 1, step.began[State.UNLOADING])
    middle = switches[step.number]
    end = switches.get(step.number + 1, step.end)
    at = step.began[State.LOADING] if step.planned_at is None else step.planned_at
    origin = controller[f"foot.{step.stance}.{name}"][at]
    true_rows = world.latest_before(controller.times[begin:end])
    true_origin = world[f"foot.{step.stance}.{name}"][world.latest_before(controller.times[at : at + 1])[0]]
    axes.plot(
        world[f"com.{name}"][true_rows] - true_origin, world[f"com_velocity.{name}"][true_rows], **_TRUE, label="true"
    )
    # another stance foot, another origin: the controller's coordinates go on, less what the estimate of the feet drifts
    for rows, style, label in ((slice(begin, middle + 1), _BEFORE, "observed, before the switch"),
                               (slice(middle, end), _AFTER, "observed, after")):  # fmt: skip
        axes.plot(
            controller[f"pendulum.{name}"][rows] - origin, controller[f"pendulum.v{name}"][rows], **style, label=label
        )
    if predicted is not None:
        for path, style, label in zip(predicted, (_PREDICTED, _PREDICTED_AFTER),
                                      ("predicted, before the switch", "predicted, after"), strict=True):  # fmt: skip
            axes.plot(path[:, 1 + axis] - origin, path[:, 3 + axis], **style, label=label)
    axes.plot(0.0, 0.0, "k*", markersize=7, label="stance foot")
    axes.plot(step.planned[axis], 0.0, "ko", markerfacecolor="none", markersize=7, label="next foot, planned")
    axes.plot(step.landed[axis], 0.0, "x", color="tab:blue", markersize=6, label="next foot, landed")
    axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
