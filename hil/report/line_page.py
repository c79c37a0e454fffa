"""The page of a sweep along one axis: share of stable runs with its intervals, and metrics, over the value."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import StrMethodFormatter

from hil.lab.stability_line import StabilityLine
from hil.report.drawing import LIMIT
from hil.report.html import document
from hil.report.margin_page import display_unit

_STABLE, _UNSTABLE = "#2e7d32", "#c0392b"


@dataclass(frozen=True)
class _Metric:
    """name: as in a run's metrics. limit: in ``unit``; None: there is none."""

    name: str
    title: str
    scale: float
    unit: str
    limit: float | None


def write_line(directory: Path, found: StabilityLine, predicted: float | None = None, more: str = "") -> Path:
    """Write ``map.png`` and ``map.html`` into ``directory``; returns the page's path.

    predicted: the value at which the linear loop becomes unstable. more: HTML for the end of the page.
    """
    figure = draw_line_figure(found, predicted)
    figure.savefig(directory / "map.png", dpi=150)
    plt.close(figure)
    path = directory / "map.html"
    path.write_text(_page(found, predicted, more), encoding="utf-8")
    return path


def sentences(found: StabilityLine) -> list[str]:
    """What was found, for a person."""
    shown, total = found.quantity.shown, sum(found.runs)
    lines = [f"{len(found.values)} values, {total} runs, {sum(found.stable)} of them stable"]
    for boundary in found.boundaries:
        side = "above" if boundary.rising else "below"
        text = f"half of the runs are stable at {shown(boundary.value)}, more {side}"
        if boundary.low is not None and boundary.high is not None and found.confidence > 0:
            text += (
                f"; the seeds tell the side of {shown(boundary.low)} and of {shown(boundary.high)} "
                f"({100 * found.confidence:.3g} % confidence)"
            )
        lines.append(text)
    if not found.boundaries and found.quantity.numeric:
        lines.append(f"no boundary: {'most' if found.share.min() >= 0.5 else 'less than half of the'} runs are stable "
                     "at all values")  # fmt: skip
    return lines


def _metrics(found: StabilityLine) -> list[_Metric]:
    limits = found.scenario.limits
    every = [
        _Metric("com_error_max", "CoM error, largest", 1e3, "mm", 1e3 * limits.com_error),
        _Metric("internal_force_error", "internal force, error", 100.0, "%", None),
        _Metric("foot_slip_max", "foot slip, largest", 1e3, "mm", 1e3 * limits.foot_slip),
        _Metric("friction_used_max", "friction used, largest", 100.0, "%", 100.0),
        _Metric("orientation_error_max", "torso's tilt, largest", 180.0 / math.pi, "°",
                math.degrees(limits.orientation_error)),
        _Metric("round_trip_p99", "round trip, p99", 1e3, "ms", None),
    ]  # fmt: skip
    return [metric for metric in every if found.metrics.get(metric.name)]


def _positions(found: StabilityLine) -> tuple[np.ndarray, float, str]:
    """Where the values stand along the axis, what the axis' numbers are of SI, and its title."""
    key = found.quantity.key
    if not found.quantity.numeric:
        return np.arange(len(found.values), dtype=float), 1.0, key
    values = [float(value) for value in found.values]
    scale, unit = display_unit(found.quantity, values)
    return np.array(values) * scale, scale, f"{key}{f' [{unit}]' if unit else ''}"


def draw_line_figure(found: StabilityLine, predicted: float | None = None) -> Any:
    """The figure: share of stable runs above, metrics below."""
    x, scale, title = _positions(found)
    metrics = _metrics(found)
    rows = 1 + -(-len(metrics) // 2)
    figure = plt.figure(figsize=(9, 2.9 + 2.3 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, 2, height_ratios=[1.4, *[1.0] * (rows - 1)])
    top = figure.add_subplot(grid[0, :])
    low, high = (np.array([interval[end] for interval in found.intervals]) for end in (0, 1))
    share = found.share
    top.errorbar(x, share, np.maximum([share - low, high - share], 0.0), fmt="o-", color="tab:blue", capsize=4,
                 linewidth=1.2, label="share of stable runs, 95 % intervals")  # fmt: skip
    top.axhline(0.5, color="0.6", linewidth=0.8)
    for number, boundary in enumerate(found.boundaries):
        label = None if number else "half of the runs stable"
        top.axvline(boundary.value * scale, color="k", linewidth=1.4, label=label)
        if boundary.low is not None and boundary.high is not None and found.confidence > 0:
            label = None if number else f"{100 * found.confidence:.3g} % confidence band"
            top.axvspan(boundary.low * scale, boundary.high * scale, color="0.85", zorder=0, label=label)
    if predicted is not None:
        top.axvline(predicted * scale, color="tab:purple", linestyle="--", label="predicted, linear loop")
    top.set(ylabel="share of stable runs", ylim=(-0.05, 1.05), title=f"{found.scenario.name}: stability")
    top.legend(fontsize=8, loc="best")
    every = [top]
    for n, metric in enumerate(metrics):
        axes = figure.add_subplot(grid[1 + n // 2, n % 2])
        points = found.metrics[metric.name]
        for stable, marker, colour, label in ((True, "o", _STABLE, "stable"), (False, "x", _UNSTABLE, "not stable")):
            own = [(x[at], value * metric.scale) for at, good, value in points if good == stable]
            if own:
                axes.plot(*zip(*own, strict=True), marker, color=colour, markersize=5, label=label)
        if metric.limit is not None:
            axes.axhline(metric.limit, **LIMIT)
        axes.set(ylabel=f"[{metric.unit}]")
        axes.set_title(metric.title, fontsize=9)
        if n == 0:
            axes.legend(fontsize=8)
        every.append(axes)
    for axes in every:
        axes.grid(alpha=0.3)
        axes.set_xlabel(title, fontsize=9)
        if not found.quantity.numeric:
            axes.set_xticks(x, [found.quantity.shown(value) for value in found.values])
        elif found.log:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.xaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
    return figure


def _page(found: StabilityLine, predicted: float | None, more: str) -> str:
    import plotly.graph_objects as go
    import plotly.io as pio
    from plotly.subplots import make_subplots

    x, scale, title = _positions(found)
    metrics = _metrics(found)
    shown = found.quantity.shown
    titles = ["share of stable runs", *(f"{metric.title} [{metric.unit}]" for metric in metrics)]
    rows = len(titles)
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=0.045)
    told = [
        f"{html.escape(shown(value))}<br>{stable} of {n} stable, {100 * low:.0f} to {100 * high:.0f} %<br>"
        f"{html.escape(reason)}"
        for value, stable, n, (low, high, _), reason in zip(
            found.values, found.stable, found.runs, found.intervals, found.reasons, strict=True
        )
    ]
    share = found.share
    low, high = (np.array([interval[end] for interval in found.intervals]) for end in (0, 1))
    figure.add_trace(
        go.Scatter(
            x=x, y=share, mode="lines+markers", text=told, hoverinfo="text", line={"color": "#1f77b4"},
            showlegend=False, marker={"size": 9},
            error_y={"type": "data", "symmetric": False, "array": high - share, "arrayminus": share - low},
        ), row=1, col=1,
    )  # fmt: skip
    for boundary in found.boundaries:
        if boundary.low is not None and boundary.high is not None and found.confidence > 0:
            figure.add_vrect(x0=boundary.low * scale, x1=boundary.high * scale, fillcolor="#999", opacity=0.2,
                             line_width=0, row=1, col=1)  # fmt: skip
        figure.add_vline(x=boundary.value * scale, line={"color": "black", "width": 2}, row="all", col=1)
    if predicted is not None:
        figure.add_vline(x=predicted * scale, line={"color": "purple", "width": 2, "dash": "dash"}, row="all", col=1)
    for row, metric in enumerate(metrics, start=2):
        for stable, symbol, colour, name in (
            (True, "circle", _STABLE, "stable"), (False, "x", _UNSTABLE, "not stable"),
        ):  # fmt: skip
            own = [
                (x[at], value * metric.scale, at) for at, good, value in found.metrics[metric.name] if good == stable
            ]
            figure.add_trace(
                go.Scatter(
                    x=[p[0] for p in own], y=[p[1] for p in own], mode="markers", name=name, legendgroup=name,
                    showlegend=row == 2, marker={"symbol": symbol, "color": colour, "size": 7},
                    text=[f"{html.escape(shown(found.values[at]))}: {y:.4g} {metric.unit}" for _, y, at in own],
                    hoverinfo="text",
                ), row=row, col=1,
            )  # fmt: skip
        if metric.limit is not None:
            figure.add_hline(y=metric.limit, line={"color": "#c0392b", "width": 1.5, "dash": "dot"}, row=row, col=1)
    figure.update_xaxes(type="log" if found.log else "linear", showticklabels=True)
    if not found.quantity.numeric:
        figure.update_xaxes(tickvals=x, ticktext=[shown(value) for value in found.values])
    figure.update_xaxes(title=title, row=rows, col=1)
    figure.update_yaxes(range=[-0.05, 1.05], row=1, col=1)
    figure.update_annotations(font_size=13)
    height = 300 + 190 * (rows - 1)
    figure.update_layout(  # the legend between the buttons and the first title, on any screen
        template="plotly_white", height=height, margin={"t": 100, "r": 15, "l": 45},
        legend={"orientation": "h", "yanchor": "top", "y": 1.0 - 40 / height, "yref": "container", "x": 0.0},
    )  # fmt: skip
    config = {"responsive": True, "displaylogo": False}
    drawing = pio.to_html(figure, full_html=False, include_plotlyjs=True, config=config)
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in sentences(found))
    if predicted is not None:
        lines += f"<li>the linear loop becomes unstable at {html.escape(shown(predicted))} (dashed)</li>"
    legend = (
        "Bars: 95 % intervals (Clopper and Pearson). "
        "Black: half of the runs are stable; grey: up to the values whose side the seeds tell. Dotted red: limits. "
        "Metrics of a run that failed are those up to its end."
    )
    return document(
        f"{found.scenario.name}: stability along {found.quantity.key}",
        f"<ul>{lines}</ul><p class=caption>{legend}</p>{drawing}{_table(found)}{more}",
    )


def _table(found: StabilityLine) -> str:
    rows = "".join(
        f"<tr><td class=n>{html.escape(found.quantity.shown(value))}</td><td class=n>{stable} of {n}</td>"
        f"<td class=n>{100 * low:.1f} % to {100 * high:.1f} %</td><td class=text>{html.escape(reason)}</td></tr>"
        for value, stable, n, (low, high, _), reason in zip(
            found.values, found.stable, found.runs, found.intervals, found.reasons, strict=True
        )
    )
    head = f"<tr><th>{html.escape(found.quantity.key)}<th>stable<th>95 % interval<th>most frequent reason</tr>"
    return f"<h2>Every value</h2><div class=wide><table>{head}{rows}</table></div>"


def record(found: StabilityLine) -> Mapping[str, Any]:
    """For JSON, SI units."""
    return {
        "scenario": found.scenario.name,
        "of": found.quantity.key,
        "unit": found.quantity.unit,
        "values": list(found.values),
        "stable": list(found.stable),
        "runs": list(found.runs),
        "intervals": [[interval.low, interval.high] for interval in found.intervals],
        "boundaries": [vars(boundary) for boundary in found.boundaries],
        "confidence": found.confidence,
    }
