"""The plots of a report: units on every axis, limits and injections drawn in, sensed over commanded."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hil.analysis.derived import Derived
from hil.analysis.latency import state_latencies
from hil.record.signals import Signals
from plant.config import TerrainConfig

_POINTS = 1500
_LIMIT: dict[str, Any] = {"color": "tab:red", "linestyle": ":", "linewidth": 1.2}
_REFERENCE: dict[str, Any] = {"color": "k", "linestyle": "--", "linewidth": 1.0}


class Plot(NamedTuple):
    title: str
    caption: str
    png: str  # base64


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
        return [
            self._centre_of_mass(),
            self._internal_force(),
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
        figure, (path, error) = _figure(1, 2, height=3.8)
        late = run.settled(run.controller)
        path.plot(*1e3 * run.com_reference[late].T, **_REFERENCE, label="reference", zorder=3)
        path.plot(*1e3 * run.com_true[late].T, linewidth=0.9, label="true")
        path.set(xlabel="x [mm]", ylabel="z [mm]")
        path.axis("equal")
        path.legend(fontsize=8)
        _line(error, run.controller.seconds, 1e3 * run.com_distance, label="true CoM to reference")
        _limit(error, 1e3 * self.limits["com_error"], "limit")
        error.set_ylim(bottom=0.0)
        self._over_time(error, "CoM error [mm]")
        error.legend(fontsize=8)
        caption = "Left: path after settling. Right: distance in the plane, once the controller has a reference."
        return Plot("Centre of mass in the sagittal plane", caption, encoded(figure))

    def _internal_force(self) -> Plot:
        world, controller = self.run.world, self.run.controller
        figure, axes = _figure()
        _line(
            axes,
            world.seconds,
            world["internal_force"],
            label="true (MuJoCo's contact forces)",
            color="tab:orange",
        )
        _line(
            axes,
            controller.seconds,
            controller["internal_force"],
            label="sensed (spring torques)",
            color="tab:blue",
        )
        axes.plot(controller.seconds, controller["internal_force_reference"], **_REFERENCE, label="reference")
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
        figure, axes = _figure(rows, 3, height=2.5 * rows)
        for ax, joint in zip(np.ravel(axes), joints, strict=False):
            _line(
                ax, controller.seconds, controller[f"torque_command.{joint}"], color="0.6", label="commanded"
            )
            _line(
                ax, controller.seconds, controller[f"torque_sensed.{joint}"], color="tab:blue", label="sensed"
            )
            self._over_time(ax, "torque [N m]")
            ax.set_title(joint.replace("_", " "), fontsize=10)
        np.ravel(axes)[0].legend(fontsize=8)
        limit = self.configuration["firmware"]["torque_limit"]
        return Plot(
            "Joint torques", f"At the joint. The drives limit them to ±{limit:g} N m.", encoded(figure)
        )

    def _buses(self) -> Plot:
        bus, firmware = self.run.bus, self.configuration["firmware"]
        figure, (load, latency) = _figure(1, 2)
        delays = {}
        for name in bus.members("load"):
            _line(load, bus.seconds, 100 * bus[f"load.{name}"], label=name.replace("_", " "))
            log = self.directory / f"{name}.log"
            if log.exists():
                times, values = state_latencies(log, firmware["rate"], firmware["report_rate"])
                delays[name] = values[times >= self.limits["settle"]]
        _limit(load, 100.0, "capacity")
        load.set_ylim(0, 115)
        self._over_time(load, "bus load [%]")
        load.legend(fontsize=8, ncols=3, loc="upper right")
        found = np.concatenate([*delays.values(), np.empty(0)])
        if len(found):
            bins = _bins(1e3 * found)
            for name, values in delays.items():
                label = f"{name.replace('_', ' ')}, {_percentiles(values)}"
                latency.hist(1e3 * values, bins=bins, histtype="step", label=label)
            latency.set(yscale="log", ylim=(0.8, 30.0 * latency.get_ylim()[1]))
            latency.legend(fontsize=8, loc="upper right")
        latency.set(xlabel="frame latency [ms]", ylabel="frames")
        caption = "Frame latency: from a joint's sample to its state's delivery, queueing and repetitions included."
        return Plot("Bus load and frame latency", caption, encoded(figure))

    def _round_trip(self) -> Plot:
        drives = self.run.drives
        figure, (over_time, histogram) = _figure(1, 2)
        trips = 1e3 * drives.group("round_trip")
        known = np.isfinite(trips)
        period = 1e3 / self.configuration["controller"]["rate"]
        worst = np.where(known, trips, -np.inf).max(axis=1, initial=-np.inf)
        shown = np.isfinite(worst)
        if shown.any():
            _line(over_time, drives.seconds[shown], worst[shown], label="slowest joint")
        known &= self.run.settled(drives)[:, None]
        if known.any():
            histogram.hist(trips[known], bins=_bins(trips[known]), label=_percentiles(1e-3 * trips[known]))
            histogram.set(yscale="log", ylim=(0.8, 6.0 * histogram.get_ylim()[1]))
        _limit(over_time, period, "servo period")
        over_time.set_ylim(bottom=0.0)
        self._over_time(over_time, "round trip [ms]")
        over_time.legend(fontsize=8)
        histogram.axvline(period, **_LIMIT, label=f"servo period {period:.3f} ms")
        histogram.set(xlabel="round trip [ms]", ylabel="commands")
        histogram.legend(fontsize=8, loc="upper right")
        caption = "From a joint's sample to the arrival, at that joint, of the command computed from it."
        return Plot("Control-cycle latency", caption, encoded(figure))

    def _stance(self) -> Plot:
        world, controller = self.run.world, self.run.controller
        figure, (tilt, ratio) = _figure(1, 2)
        for name, colour in (("roll", "tab:blue"), ("pitch", "tab:orange")):
            _line(tilt, world.seconds, np.degrees(world[f"base.{name}"]), label=f"{name}, true", color=colour)
            angles = np.degrees(controller[name])
            _line(
                tilt, controller.seconds, angles, label="estimated", color=colour, alpha=0.6, linestyle="--"
            )
        limit = np.degrees(self.limits["orientation_error"])
        _limit(tilt, limit, "limit ±")
        _limit(tilt, -limit, "")
        self._over_time(tilt, "torso [°]")
        tilt.legend(ncols=2, fontsize=8)
        for foot, values in self.run.friction_ratio.items():
            _line(ratio, world.seconds, values, label=foot.replace("_", " "))
        friction = self.configuration["terrain"]["friction"]
        ratio.axhline(friction, **_LIMIT, label="friction coefficient")
        ratio.set_ylim(0, 1.4 * max(friction, 0.1))
        self._over_time(ratio, "tangential / normal force")
        ratio.legend(fontsize=8)
        caption = "Beyond the friction coefficient a foot slides."
        return Plot("Orientation and use of friction", caption, encoded(figure))


def _line(axes: Any, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    axes.plot(*envelope(x, y), **{"linewidth": 1.0, **style})


def _limit(axes: Any, value: float, label: str) -> None:
    """A limit as a line; one far beyond the data is only named, or there would be nothing else to see."""
    reach = max((np.nanmax(np.abs(line.get_ydata()), initial=0.0) for line in axes.get_lines()), default=0.0)
    text = f"{label} {value:.3g}" if label else None
    if abs(value) <= 8.0 * reach:
        axes.axhline(value, **_LIMIT, label=text)
    elif label:
        axes.plot([], [], **_LIMIT, label=f"{text}, beyond the axis")


def _percentiles(seconds: np.ndarray) -> str:
    p50, p99 = 1e3 * np.percentile(seconds, [50, 99]) if len(seconds) else (np.nan, np.nan)
    return f"p50 {p50:.3f} ms, p99 {p99:.3f} ms"


def _bins(values: np.ndarray) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    return np.linspace(0.0 if low < 0.5 * high else low - 0.02 * high, high + 0.02 * abs(high) + 1e-6, 61)


def _figure(*shape: int, height: float = 3.2) -> tuple[Any, Any]:
    figure, axes = plt.subplots(*(shape or (1, 1)), figsize=(9, height), layout="constrained")
    for ax in np.ravel(axes):
        ax.grid(alpha=0.3)
    return figure, axes


def encoded(figure: Any) -> str:
    """``figure`` as PNG in base64; it is closed."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()
