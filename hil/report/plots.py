"""The plots of a report: units on every axis, limits and injections drawn in, sensed over commanded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hil.analysis.derived import Derived
from hil.analysis.latency import state_latencies
from hil.record.signals import Signals
from hil.report.drawing import (
    LIMIT,
    REFERENCE,
    Plot,
    bin_edges,
    draw_limit,
    draw_line,
    encoded,
    envelope,
    new_figure,
    percentiles,
)
from plant.config import TerrainConfig

__all__ = ["Plot", "draw", "encoded", "envelope"]


def draw(record: Mapping[str, Any], tables: Mapping[str, Signals], directory: Path) -> list[Plot]:
    """Every plot of the run whose bus logs are in ``directory``."""
    return _Drawing(record, tables, directory).plots()


class _Drawing:
    def __init__(self, record: Mapping[str, Any], tables: Mapping[str, Signals], directory: Path) -> None:
        self.configuration = record["configuration"]
        self.limits = self.configuration["limits"]
        self.injected = [injection["time_s"] for injection in record["injected"]]
        self.directory = directory
        terrain = TerrainConfig.model_construct(**self.configuration["terrain"])
        self.run = Derived(tables, terrain, self.limits["settle"])
        self.end = record["simulated_time"]

    def plots(self) -> list[Plot]:
        sensed = np.isfinite(self.run.controller["internal_force"]).any()
        return [
            self._centre_of_mass(),
            *([self._internal_force()] if sensed or not len(self.run.controller) else []),
            self._torques(),
            self._buses(),
            self._round_trip(),
            self._stance(),
        ]

    def _over_time(self, axes: Any, ylabel: str) -> None:
        """Dress axes over time: settling in grey, injections as vertical lines."""
        axes.set(xlabel="t [s]", ylabel=ylabel, xlim=(0.0, self.end))
        axes.axvspan(0.0, min(self.limits["settle"], self.end), color="0.93", zorder=0)
        for at in self.injected:
            axes.axvline(at, color="tab:purple", linestyle="-.", linewidth=0.9)

    def _centre_of_mass(self) -> Plot:
        run = self.run
        figure, (path, error) = new_figure(1, 2, height=3.8)
        late = run.settled(run.controller)
        path.plot(*1e3 * run.com_reference[late].T, **REFERENCE, label="reference", zorder=3)
        path.plot(*1e3 * run.com_true[late].T, linewidth=0.9, label="true")
        path.set(xlabel="x [mm]", ylabel="z [mm]")
        path.axis("equal")
        path.legend(fontsize=8)
        draw_line(error, run.controller.seconds, 1e3 * run.com_distance, label="true CoM to reference")
        draw_limit(error, 1e3 * self.limits["com_error"], "limit")
        error.set_ylim(bottom=0.0)
        self._over_time(error, "CoM error [mm]")
        error.legend(fontsize=8)
        caption = "Left: path after settling. Right: distance in the plane, once the controller has a reference."
        return Plot("Centre of mass in the sagittal plane", caption, encoded(figure))

    def _internal_force(self) -> Plot:
        world, controller = self.run.world, self.run.controller
        figure, axes = new_figure()
        draw_line(
            axes,
            world.seconds,
            world["internal_force"],
            label="true (MuJoCo's contact forces)",
            color="tab:orange",
        )
        draw_line(
            axes,
            controller.seconds,
            controller["internal_force"],
            label="sensed (spring torques)",
            color="tab:blue",
        )
        axes.plot(controller.seconds, controller["internal_force_reference"], **REFERENCE, label="reference")
        both = np.concatenate([world["internal_force"][self.run.settled(world)],
                               controller["internal_force"][self.run.settled(controller)],
                               controller["internal_force_reference"]])  # fmt: skip
        both = both[np.isfinite(both)]
        low, high = both.min(initial=0.0), both.max(initial=0.0)  # without the touch-down's peak
        span = max(high - low, 10.0)
        axes.set_ylim(low - 0.1 * span, high + 0.25 * span)
        self._over_time(axes, "internal force [N]")
        axes.legend(ncols=3, fontsize=8, loc="upper right")
        caption = "Along the line between the feet; positive pushes them apart."
        return Plot("Internal force between the feet", caption, encoded(figure))

    def _torques(self) -> Plot:
        controller = self.run.controller
        joints = controller.members("torque_command")
        rows = -(-len(joints) // 3)
        figure, axes = new_figure(rows, 3, height=2.5 * rows)
        for ax, joint in zip(np.ravel(axes), joints, strict=False):
            draw_line(ax, controller.seconds, controller[f"torque_command.{joint}"], color="0.6", label="commanded")
            draw_line(ax, controller.seconds, controller[f"torque_sensed.{joint}"], color="tab:blue", label="sensed")
            self._over_time(ax, "torque [N m]")
            ax.set_title(joint.replace("_", " "), fontsize=10)
        np.ravel(axes)[0].legend(fontsize=8)
        limit = self.configuration["firmware"]["torque_limit"]
        return Plot("Joint torques", f"At the joint. The drives limit them to ±{limit:g} N m.", encoded(figure))

    def _buses(self) -> Plot:
        bus, firmware = self.run.bus, self.configuration["firmware"]
        figure, (load, latency) = new_figure(1, 2)
        delays = {}
        for name in bus.members("load"):
            draw_line(load, bus.seconds, 100 * bus[f"load.{name}"], label=name.replace("_", " "))
            log = self.directory / f"{name}.log"
            if log.exists():
                times, values = state_latencies(log, firmware["rate"], firmware["report_rate"])
                delays[name] = values[times >= self.limits["settle"]]
        draw_limit(load, 100.0, "capacity")
        load.set_ylim(0, 115)
        self._over_time(load, "bus load [%]")
        load.legend(fontsize=8, ncols=3, loc="upper right")
        found = np.concatenate([*delays.values(), np.empty(0)])
        if len(found):
            edges = bin_edges(1e3 * found)
            for name, values in delays.items():
                label = f"{name.replace('_', ' ')}, {percentiles(values)}"
                latency.hist(1e3 * values, bins=edges, histtype="step", label=label)
            latency.set(yscale="log", ylim=(0.8, 30.0 * latency.get_ylim()[1]))
            latency.legend(fontsize=8, loc="upper right")
        latency.set(xlabel="frame latency [ms]", ylabel="frames")
        caption = "Frame latency: from a joint's sample to its state's delivery, queueing and repetitions included."
        return Plot("Bus load and frame latency", caption, encoded(figure))

    def _round_trip(self) -> Plot:
        drives = self.run.drives
        figure, (over_time, histogram) = new_figure(1, 2)
        trips = 1e3 * drives.group("round_trip")
        known = np.isfinite(trips)
        period = 1e3 / self.configuration["controller"]["rate"]
        worst = np.where(known, trips, -np.inf).max(axis=1, initial=-np.inf)
        shown = np.isfinite(worst)
        if shown.any():
            draw_line(over_time, drives.seconds[shown], worst[shown], label="slowest joint")
        known &= self.run.settled(drives)[:, None]
        if known.any():
            histogram.hist(trips[known], bins=bin_edges(trips[known]), label=percentiles(1e-3 * trips[known]))
            histogram.set(yscale="log", ylim=(0.8, 6.0 * histogram.get_ylim()[1]))
        draw_limit(over_time, period, "servo period")
        over_time.set_ylim(bottom=0.0)
        self._over_time(over_time, "round trip [ms]")
        over_time.legend(fontsize=8)
        histogram.axvline(period, **LIMIT, label=f"servo period {period:.3f} ms")
        histogram.set(xlabel="round trip [ms]", ylabel="commands")
        histogram.legend(fontsize=8, loc="upper right")
        caption = "From a joint's sample to the arrival, at that joint, of the command computed from it."
        return Plot("Control-cycle latency", caption, encoded(figure))

    def _stance(self) -> Plot:
        world, controller = self.run.world, self.run.controller
        figure, (tilt, ratio) = new_figure(1, 2)
        for name, colour in (("roll", "tab:blue"), ("pitch", "tab:orange")):
            draw_line(tilt, world.seconds, np.degrees(world[f"base.{name}"]), label=f"{name}, true", color=colour)
            angles = np.degrees(controller[name])
            draw_line(tilt, controller.seconds, angles, label="estimated", color=colour, alpha=0.6, linestyle="--")
        limit = np.degrees(self.limits["orientation_error"])
        draw_limit(tilt, limit, "limit ±")
        draw_limit(tilt, -limit, "")
        self._over_time(tilt, "torso [°]")
        tilt.legend(ncols=2, fontsize=8)
        for foot, values in self.run.friction_ratio.items():
            draw_line(ratio, world.seconds, values, label=foot.replace("_", " "))
        friction = self.configuration["terrain"]["friction"]
        ratio.axhline(friction, **LIMIT, label="friction coefficient")
        ratio.set_ylim(0, 1.4 * max(friction, 0.1))
        self._over_time(ratio, "tangential / normal force")
        ratio.legend(fontsize=8)
        caption = "Beyond the friction coefficient a foot slides."
        return Plot("Orientation and use of friction", caption, encoded(figure))
