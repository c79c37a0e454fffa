"""Pictures of foot placement: eigenvalues over its parameters, and a phase portrait from step to step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from central_controller.planning.config import PlannerConfig
from central_controller.planning.gait import Gait
from central_controller.planning.height_surface import Plane
from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
from central_controller.planning.reach import LEFT
from central_controller.planning.rehearsal import rehearse
from central_controller.planning.velocity_reversal import VelocityReversalPlanner

_LIMIT: dict[str, Any] = {"color": "tab:red", "linestyle": ":", "linewidth": 1.6}
_STEPS = 8
_NUMBERED = 3  # the feet of later steps lie upon one another
_HALF_WIDTH = 0.12  # m, of the feet at the start
_PUSH = 0.15  # m/s forwards at the start


def stability_map(gait: Gait, path: Path) -> None:
    """The greater |λ| over κ and t', with the limits of stability in closed form and the gait's own point."""
    kappas = np.linspace(0.0, max(1.0, 1.5 * gait.kappa), 161)
    times = np.linspace(0.8 * 0.5 * gait.step_time, max(1.5 * gait.step_time, 1.2 * gait.reversal_time), 201)
    size = np.array([[replace(gait, kappa=k, reversal_time=t).magnitude for k in kappas] for t in times])
    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    filled = axes.contourf(kappas, times * 1e3, size, levels=np.arange(0.4, 1.41, 0.1), cmap="viridis_r", extend="both")
    figure.colorbar(filled, ax=axes, label="greater |λ| from step to step [1]")
    axes.contour(kappas, times * 1e3, size, levels=[0.8], colors="white", linewidths=1.2)
    limits = np.array([replace(gait, kappa=k).stable_reversal_times() for k in kappas])
    axes.plot(kappas, 1e3 * limits[:, 0], **_LIMIT, label="limits of stability in closed form")
    axes.plot(kappas, 1e3 * limits[:, 1], **_LIMIT)
    axes.plot(
        gait.kappa,
        1e3 * gait.reversal_time,
        "ko",
        label=f"κ {gait.kappa:.3g}, t′ {1e3 * gait.reversal_time:.4g} ms, |λ| {gait.magnitude:.2f}",
    )
    axes.set(xlabel="κ [1]", ylabel="t′ [ms]", xlim=(0.0, kappas[-1]), ylim=(1e3 * times[0], 1e3 * times[-1]))
    axes.set_title(
        f"centre of mass {gait.height:g} m high, {1e3 * gait.step_time:g} ms per step; white: 0.8", fontsize=10
    )
    axes.legend(fontsize=8, loc="upper right")
    _save(figure, path)


def portrait(gait: Gait, path: Path) -> None:
    """The pendulum, pushed forwards, walks eight steps on the spot: x and y over their velocities, swing extended."""
    config = PlannerConfig().model_copy(update={
        "kappa_x": gait.kappa, "kappa_y": gait.kappa,
        "reversal_time_x": gait.reversal_time, "reversal_time_y": gait.reversal_time,
    })  # fmt: skip
    pendulum = Pendulum(Plane(gait.height), gait.gravity)
    towards = -_HALF_WIDTH * gait.omega * np.tanh(gait.omega * gait.reversal_time)
    start = PendulumState(0.0, 0.0, _PUSH, float(towards))
    stance = Foot(0.0, -_HALF_WIDTH)
    planner = VelocityReversalPlanner(config, pendulum)
    walked = rehearse(planner, pendulum, start, stance, LEFT, gait.step_time, _STEPS)
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 4.4), layout="constrained")
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, _STEPS))
    for column, (axes, name) in enumerate(zip(panels, "xy", strict=True)):
        for n, (step, colour) in enumerate(zip(walked, colours, strict=True)):
            way = step.path
            axes.plot(way[:, 1 + column], way[:, 3 + column], color=colour, linewidth=1.3)
            axes.plot(way[-1, 1 + column], way[-1, 3 + column], "D", color=colour, markersize=4)
            axes.plot(step.stance[column], 0.0, "o", markerfacecolor="none", color=colour, markersize=7)
            if n < _NUMBERED:
                axes.annotate(str(n + 1), (step.stance[column], 0.0), (0, 6), textcoords="offset points", fontsize=8)
        axes.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
        axes.set(xlabel=f"{name} [m]", ylabel=f"velocity of {name} [m/s]")
    extension = 1e3 * sum(step.plan.extension for step in walked) / _STEPS
    figure.suptitle(
        f"pushed by {_PUSH:g} m/s, κ {gait.kappa:.3g}, t′ {1e3 * gait.reversal_time:.4g} ms, swing extended by "
        f"{extension:.0f} ms on average\n◇ change of the stance foot, ○ stance foot of step 1, 2, 3 …",
        fontsize=10,
    )
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=120)
    plt.close(figure)
