"""What plots over time are drawn with: figures, thinned lines, limits that do not hide the data, PNG in base64."""

from __future__ import annotations

import base64
import io
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

POINTS = 1500
LIMIT: dict[str, Any] = {"color": "tab:red", "linestyle": ":", "linewidth": 1.2}
REFERENCE: dict[str, Any] = {"color": "k", "linestyle": "--", "linewidth": 1.0}


class Plot(NamedTuple):
    title: str
    caption: str
    png: str  # base64


def envelope(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thin a signal for drawing, keeping the extremes of every bin."""
    if len(x) <= 2 * POINTS:
        return x, y
    size = len(x) // POINTS
    n = len(x) // size * size
    bins = y[:n].reshape(-1, size)
    rows = np.arange(len(bins))
    order = np.sort(np.stack([bins.argmin(axis=1), bins.argmax(axis=1)], axis=1), axis=1)
    index = (rows[:, None] * size + order).ravel()
    return x[index], y[index]


def draw_line(axes: Any, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    """A signal, thinned."""
    axes.plot(*envelope(x, y), **{"linewidth": 1.0, **style})


def draw_limit(axes: Any, value: float, label: str) -> None:
    """A limit as a line; one far beyond the data is only named, or there would be nothing else to see."""
    reach = max((np.nanmax(np.abs(line.get_ydata()), initial=0.0) for line in axes.get_lines()), default=0.0)
    text = f"{label} {value:.3g}" if label else None
    if abs(value) <= 8.0 * reach:
        axes.axhline(value, **LIMIT, label=text)
    elif label:
        axes.plot([], [], **LIMIT, label=f"{text}, beyond the axis")


def percentiles(seconds: np.ndarray) -> str:
    """Of times (n,), for a legend."""
    p50, p99 = 1e3 * np.percentile(seconds, [50, 99]) if len(seconds) else (np.nan, np.nan)
    return f"p50 {p50:.3f} ms, p99 {p99:.3f} ms"


def bin_edges(values: np.ndarray) -> np.ndarray:
    """Of a histogram of ``values`` (n,), n > 0; from 0 on if that does not squeeze them."""
    low, high = float(values.min()), float(values.max())
    return np.linspace(0.0 if low < 0.5 * high else low - 0.02 * high, high + 0.02 * abs(high) + 1e-6, 61)


def new_figure(*shape: int, height: float = 3.2) -> tuple[Any, Any]:
    """A figure as wide as a page, with axes of this shape (rows, columns) and a grid; ``height`` in inches."""
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
