"""Pictures of a stability map: PNG for papers, and a page on which places tell what happened there."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import StrMethodFormatter
from matplotlib.tri import Triangulation

from hil.lab.quantity import Quantity
from hil.lab.stability_map import StabilityMap
from hil.report.html import document
from hil.report.margin_page import display_unit

_COLOURS = "RdYlBu"  # told apart by the colour-blind, and in grey
_BOUNDARY: dict[str, Any] = {"color": "k", "linewidth": 1.6}
_BAND: dict[str, Any] = {"color": "k", "linewidth": 0.9, "linestyle": ":"}
_PREDICTED: dict[str, Any] = {"color": "tab:purple", "linestyle": "--", "linewidth": 2.0, "marker": "o",
                              "markersize": 4}  # fmt: skip
_TICKS = 12  # values of an axis that are all written
_SURE = 0.99  # of ±1: the band's edges run through the last places that are decided
Curve = Sequence[tuple[float, float]]  # points of a boundary, SI


def write_map(directory: Path, found: StabilityMap, predicted: Sequence[Curve] = (), more: str = "") -> Path:
    """Write ``map.png`` and ``map.html`` into ``directory``; returns the page's path. ``predicted``: boundaries to draw
    beside the one found. ``more``: HTML for the end of the page."""
    figure, boundary, band = _draw(found, predicted)
    figure.savefig(directory / "map.png", dpi=200)
    plt.close(figure)
    path = directory / "map.html"
    path.write_text(_page(found, boundary, band, predicted, more), encoding="utf-8")
    return path


def caption(found: StabilityMap) -> str:
    """What there is to be seen."""
    fewest, most = found.runs.min(), found.runs.max()
    runs = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    doubt = int(np.count_nonzero(found.decided == 0))
    text = f"{len(found.x)} places, {runs} runs each. Line: half of the runs are stable. "
    if found.confidence <= 0:
        return text + "One seed has no confidence band."
    return text + (
        f"Dotted: the last places whose side the seeds tell ({100 * found.confidence:.3g} % confidence); "
        f"{doubt} places lie between."
    )


def _scaled(quantity: Quantity, values: np.ndarray) -> tuple[np.ndarray, float, str]:
    scale, unit = display_unit(quantity, values.tolist())
    return values * scale, scale, f"{quantity.key}{f' [{unit}]' if unit else ''}"


def _draw(found: StabilityMap, predicted: Sequence[Curve]) -> tuple[Any, list[np.ndarray], list[np.ndarray]]:
    """The figure, and the curves of boundary and band in SI units."""
    x, x_scale, x_label = _scaled(found.x_quantity, found.x)
    y, y_scale, y_label = _scaled(found.y_quantity, found.y)
    figure, axes = plt.subplots(figsize=(7, 5), layout="constrained")
    for log, name, line in ((found.x_log, "x", axes.xaxis), (found.y_log, "y", axes.yaxis)):
        if log:
            axes.set(**{f"{name}scale": "log"})
            line.set_major_formatter(StrMethodFormatter("{x:g}"))
            line.set_minor_formatter(StrMethodFormatter("{x:g}"))
    if found.shape is not None:
        grid = [values.reshape(found.shape) for values in (x, y, found.share)]
        mesh: Any = axes.pcolormesh(*grid, cmap=_COLOURS, vmin=0, vmax=1, shading="nearest", alpha=0.85)
    else:
        mesh = axes.scatter(x, y, c=found.share, cmap=_COLOURS, vmin=0, vmax=1, s=30, edgecolors="0.4", linewidths=0.4)
    figure.colorbar(mesh, label="share of stable runs")
    boundary = _contours(axes, found, x, y, found.share, [0.5], _BOUNDARY)
    band = _contours(axes, found, x, y, found.decided, [-_SURE, _SURE], _BAND) if found.confidence > 0 else []
    axes.plot([], [], **_BOUNDARY, label="half of the runs stable")
    if found.confidence > 0:
        axes.plot([], [], **_BAND, label=f"{100 * found.confidence:.3g} % confidence band")
    for number, curve in enumerate(predicted):
        points = np.array(curve) * (x_scale, y_scale)
        label = None if number else "predicted, linear loop"
        axes.plot(*points.T, label=label, **_PREDICTED, path_effects=[Stroke(linewidth=4.0, foreground="w"), Normal()])
    nominal = found.nominal[0] * x_scale, found.nominal[1] * y_scale
    if _inside(found):
        axes.plot(*nominal, "*", color="w", markeredgecolor="k", markersize=14, clip_on=False, zorder=5,
                  label="the scenario's own values")  # fmt: skip
    axes.set(xlabel=x_label, ylabel=y_label, title=f"{found.scenario}: stability")
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    return figure, [c / (x_scale, y_scale) for c in boundary], [c / (x_scale, y_scale) for c in band]


def _scale(values: np.ndarray, log: bool) -> dict[str, Any]:
    """Of an axis of the page. A logarithmic one is labelled with whole numbers: Plotly's own are digits without their
    decade."""
    if not log:
        return {"type": "linear"}
    decades = np.arange(np.floor(np.log10(values.min())), np.ceil(np.log10(values.max())) + 1.0)
    ticks = np.unique(values)
    if len(ticks) > _TICKS:
        ticks = np.outer(10.0**decades, (1.0, 2.0, 5.0)).ravel()
    return {"type": "log", "tickvals": ticks, "ticktext": [f"{tick:.3g}" for tick in ticks]}


def _inside(found: StabilityMap) -> bool:
    (nx, ny), logs = found.nominal, (found.x_log, found.y_log)
    reach = [
        (v.min() * 0.8, v.max() * 1.25) if log else (v.min() - 0.1 * np.ptp(v), v.max() + 0.1 * np.ptp(v))
        for v, log in zip((found.x, found.y), logs, strict=True)
    ]
    return reach[0][0] <= nx <= reach[0][1] and reach[1][0] <= ny <= reach[1][1]


def _contours(
    axes: Any, found: StabilityMap, x: np.ndarray, y: np.ndarray, values: np.ndarray, levels: list[float],
    style: dict[str, Any],
) -> list[np.ndarray]:  # fmt: skip
    """Draw contours; returns their points. None where all places are alike, or there are too few."""
    if not any(values.min() < level < values.max() for level in levels):
        return []
    arguments = {"levels": levels, "colors": style["color"], "linewidths": style["linewidth"],
                 "linestyles": style.get("linestyle", "-")}  # fmt: skip
    if found.shape is not None:
        if min(found.shape) < 2:
            return []
        drawn = axes.contour(*(v.reshape(found.shape) for v in (x, y, values)), **arguments)
    else:
        if len(x) < 4:
            return []
        near = Triangulation(_unit(x, found.x_log), _unit(y, found.y_log))  # as near as they look
        drawn = axes.tricontour(Triangulation(x, y, near.triangles), values, **arguments)
    return [np.asarray(segment) for level in drawn.allsegs for segment in level if len(segment) > 1]


def _unit(values: np.ndarray, log: bool) -> np.ndarray:
    """From 0 to 1 along the axis."""
    values = np.log(values) if log else values
    return (values - values.min()) / np.ptp(values)


def _page(
    found: StabilityMap, boundary: list[np.ndarray], band: list[np.ndarray], predicted: Sequence[Curve], more: str
) -> str:
    import plotly.graph_objects as go
    import plotly.io as pio

    x, x_scale, x_label = _scaled(found.x_quantity, found.x)
    y, y_scale, y_label = _scaled(found.y_quantity, found.y)
    told = [
        f"{found.x_quantity.shown(a)}, {found.y_quantity.shown(b)}<br>"
        f"{share * n:.0f} of {n} stable<br>{html.escape(reason)}"
        for a, b, share, n, reason in zip(found.x, found.y, found.share, found.runs, found.reasons, strict=True)
    ]
    bar = {"title": "share stable", "thickness": 12}
    shared: dict[str, Any] = {"colorscale": _COLOURS, "showscale": True, "colorbar": bar}
    figure = go.Figure()
    if found.shape is not None:
        figure.add_heatmap(
            x=x.reshape(found.shape)[0], y=y.reshape(found.shape)[:, 0], z=found.share.reshape(found.shape), zmin=0,
            zmax=1, text=np.array(told).reshape(found.shape), hoverinfo="text", opacity=0.85, **shared,
        )  # fmt: skip
    else:
        line = {"width": 1, "color": "#666"}
        marker = {"color": found.share, "cmin": 0, "cmax": 1, "size": 10, "line": line, **shared}
        figure.add_scatter(x=x, y=y, mode="markers", marker=marker, text=told, hoverinfo="text", showlegend=False)
    lines = [np.array(c) for c in predicted]
    for curve in lines:  # under the predicted ones, so that they stand out from dark places
        white = {"color": "white", "width": 5}
        figure.add_scatter(x=curve[:, 0] * x_scale, y=curve[:, 1] * y_scale, mode="lines", line=white, hoverinfo="skip",
                           showlegend=False)  # fmt: skip
    for curves, name, line in (
        (boundary, "half of the runs stable", {"color": "black", "width": 2.5}),
        (band, f"{100 * found.confidence:.3g} % confidence band", {"color": "black", "width": 1.2, "dash": "dot"}),
        (lines, "predicted, linear loop", {"color": "purple", "width": 2, "dash": "dash"}),
    ):
        for number, curve in enumerate(curves):
            figure.add_scatter(
                x=curve[:, 0] * x_scale, y=curve[:, 1] * y_scale, mode="lines", line=line, name=name,
                legendgroup=name, showlegend=number == 0, hoverinfo="skip",
            )  # fmt: skip
    if _inside(found):
        figure.add_scatter(
            x=[found.nominal[0] * x_scale], y=[found.nominal[1] * y_scale], mode="markers",
            name="the scenario's own values",
            marker={"symbol": "star", "size": 16, "color": "white", "line": {"color": "black", "width": 1.5}},
        )  # fmt: skip
    figure.update_xaxes(title=x_label, **_scale(x, found.x_log))
    figure.update_yaxes(title=y_label, **_scale(y, found.y_log))
    figure.update_layout(template="plotly_white", legend={"orientation": "h", "y": -0.2}, height=560,
                         margin={"t": 45, "r": 10, "l": 45})  # fmt: skip
    config = {"responsive": True, "displaylogo": False}
    drawing = pio.to_html(figure, full_html=False, include_plotlyjs=True, config=config)
    return document(f"{found.scenario}: stability", f"<p>{html.escape(caption(found))}</p>{drawing}{more}")
