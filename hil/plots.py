"""The plots of a report: units on every axis, limits drawn in, commanded over sensed."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hil.signals import Signals

_POINTS = 1500
SERVO_PERIOD_S = 667e-6


def envelope(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thin a signal for drawing, keeping the extremes of every bin."""
    if len(x) <= 2 * _POINTS:
        return x, y
    size = len(x) // _POINTS
    n = len(x) // size * size
    bins = y[:n].reshape(-1, size)
    rows = np.arange(len(bins))
    order = np.sort(np.stack([bins.argmin(axis=1), bins.argmax(axis=1)], axis=1), axis=1)
    index = (rows[:, None] * size + order).ravel()
    return x[index], y[index]


def _line(axes: Any, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    axes.plot(*envelope(x, y), **{"linewidth": 1.0, **style})


def _figure(*shape: int, height: float = 3.2) -> tuple[Any, Any]:
    figure, axes = plt.subplots(*(shape or (1, 1)), figsize=(9, height), layout="constrained")
    for ax in np.ravel(axes):
        ax.grid(alpha=0.3)
    return figure, axes


def _encoded(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def draw(record: Mapping[str, Any], tables: Mapping[str, Signals]) -> list[tuple[str, str]]:
    """Title and PNG (base64) of every plot."""
    controller, world = tables["controller"], tables["world"]
    drives, bus = tables["drives"], tables["bus"]
    limits = record["configuration"]["limits"]
    time, settle = controller.seconds, limits["settle"]
    late = time >= settle
    at = np.maximum(world.latest_before(controller.times), 0)
    true_x, true_z = world["com.x"][at], world["com.z"][at]
    plots: list[tuple[str, str]] = []

    figure, (path, error) = _figure(1, 2, height=3.6)
    path.plot(1e3 * controller["com_reference.x"][late], 1e3 * controller["com_reference.z"][late], "k--", label="reference")
    path.plot(1e3 * true_x[late], 1e3 * true_z[late], linewidth=0.8, label="true")
    path.set(xlabel="x [mm]", ylabel="z [mm]")
    path.axis("equal")
    path.legend()
    distance = np.hypot(true_x - controller["com_reference.x"], true_z - controller["com_reference.z"])
    _line(error, time, 1e3 * distance, label="true CoM to reference")
    error.axhline(1e3 * limits["com_error"], color="r", linestyle=":", label="limit")
    error.axvline(settle, color="0.6", linewidth=0.8)
    error.set(xlabel="t [s]", ylabel="CoM error [mm]")
    error.legend()
    plots.append(("Centre of mass in the sagittal plane", _encoded(figure)))

    figure, axes = _figure()
    _line(axes, world.seconds, world["internal_force"], label="true (contact forces)", alpha=0.6)
    _line(axes, time, controller["internal_force"], label="sensed (spring torques)")
    _line(axes, time, controller["internal_force_reference"], color="k", linestyle="--", label="reference")
    axes.set(xlabel="t [s]", ylabel="internal force [N]")
    span = np.abs(world["internal_force"][world.seconds >= settle])
    if len(span):
        axes.set_ylim(min(0.0, -1.2 * span.max() * 0.1), 1.4 * max(span.max(), 1.0))
    axes.legend(ncols=3)
    plots.append(("Internal force between the feet", _encoded(figure)))

    figure, axes = _figure(2, 3, height=5.0)
    for ax, name in zip(axes.ravel(), controller.members("torque_command"), strict=False):
        joint = name.removeprefix("torque_command.")
        _line(ax, time, controller[f"torque_sensed.{joint}"], label="sensed")
        _line(ax, time, controller[f"torque_command.{joint}"], label="commanded", color="k", alpha=0.7)
        ax.set(title=joint.replace("_", " "), xlabel="t [s]", ylabel="torque [N m]")
    axes[0, 0].legend()
    plots.append(("Joint torques", _encoded(figure)))

    figure, (left, right) = _figure(1, 2)
    for name in bus.members("load"):
        _line(left, bus.seconds, 100 * bus[f"{name}" if name in bus else f"load.{name}"], label=name.removeprefix("load."))
    left.set(xlabel="t [s]", ylabel="bus load [%]", ylim=(0, 100))
    left.legend()
    trips = drives.group("round_trip")
    trips = trips[np.isfinite(trips)]
    if len(trips):
        right.hist(1e3 * trips, bins=60)
        for share in (50, 99):
            right.axvline(1e3 * np.percentile(trips, share), color="k", linestyle="--", linewidth=0.8)
            right.text(1e3 * np.percentile(trips, share), right.get_ylim()[1] * share / 110, f"p{share}")
    right.axvline(1e3 * SERVO_PERIOD_S, color="r", linestyle=":", label="0.667 ms")
    right.set(xlabel="sample to command, round trip [ms]", ylabel="commands", yscale="log")
    right.legend()
    plots.append(("Bus load and control-cycle latency", _encoded(figure)))

    figure, (tilt, ratio) = _figure(1, 2)
    for name in ("roll", "pitch"):
        _line(tilt, world.seconds, np.degrees(world[f"base.{name}"]), label=f"{name}, true")
        _line(tilt, time, np.degrees(controller[name]), label=f"{name}, estimated", alpha=0.6)
    tilt.set(xlabel="t [s]", ylabel="torso [°]")
    tilt.legend(ncols=2, fontsize=8)
    from hil.derived import Derived
    from plant.config import TerrainConfig

    terrain = record["configuration"]["terrain"]
    settings = TerrainConfig.model_construct(**terrain)
    used = Derived(tables, settings, settle).friction_ratio
    for foot, values in used.items():
        _line(ratio, world.seconds[-len(values):], values, label=foot.replace("_", " "))
    ratio.axhline(terrain["friction"], color="r", linestyle=":", label="friction coefficient")
    ratio.set(xlabel="t [s]", ylabel="tangential over normal force", ylim=(0, 1.5 * max(terrain["friction"], 0.1)))
    ratio.legend(fontsize=8)
    plots.append(("Orientation and use of friction", _encoded(figure)))
    return plots
