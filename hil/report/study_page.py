"""The page of a study: what it claims in sentences, the maps, the tables behind them."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from hil.report.html import document, picture
from hil.report.plots import encoded
from hil.studies.study import Field, Findings, Study, Table

_LABEL: dict[str, Any] = {"facecolor": "w", "alpha": 0.75, "linewidth": 0, "pad": 1.5}
_LINES: tuple[dict[str, Any], ...] = (
    {"color": "k"},
    {"color": "k", "linestyle": "--"},
    {"color": "tab:purple", "linestyle": ":"},
)


def sentences(findings: Findings) -> list[str]:
    """The claims with their verdicts and numbers, a line each."""
    lines = []
    for claim in findings.claims:
        lines += [f"{claim.claim} It {claim.verdict} here.", *(f"  {number}" for number in claim.numbers)]
    return lines


def columns(table: Table) -> list[str]:
    """A table as text, a line each."""
    rows = [table.head, *table.rows]
    widths = [max(len(row[n]) for row in rows) for n in range(len(table.head))]
    return [
        table.title,
        *("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows),
    ]


def draw(field: Field) -> Figure:
    """One map."""
    figure, axes = plt.subplots(figsize=(7.5, 5.2), layout="constrained")
    x, y = (_edges(values, log) for values, log in zip((field.x, field.y), field.logarithmic, strict=True))
    low, high = field.limits
    mesh = axes.pcolormesh(x, y, field.values, cmap=field.colours, vmin=low, vmax=high, alpha=0.85)
    axes.set(xscale="log" if field.logarithmic[0] else "linear", yscale="log" if field.logarithmic[1] else "linear")
    for line, values in ((axes.xaxis, field.x), (axes.yaxis, field.y)):
        line.set_major_locator(FixedLocator(values.tolist()))
        line.set_minor_locator(NullLocator())
        line.set_major_formatter(StrMethodFormatter("{x:g}"))
    for n, row in enumerate(field.texts):
        for m, text in enumerate(row):
            axes.text(field.x[m], field.y[n], text, ha="center", va="center", fontsize=8, bbox=_LABEL)
    for style, (name, (xs, ys)) in zip(_LINES, field.curves.items(), strict=False):
        axes.plot(xs, ys, marker="o", markersize=4, linewidth=1.6, label=name, **style)
    if field.zero and field.values.min() < 0.0 < field.values.max() and min(field.values.shape) > 1:
        axes.contour(field.x, field.y, field.values, levels=[0.0], colors="k", linewidths=1.6)
    figure.colorbar(mesh, label=field.value_label)
    axes.set(xlabel=field.x_label, ylabel=field.y_label, title=field.title)
    if field.curves:
        figure.legend(fontsize=8, loc="outside lower center")
    return figure


def _edges(values: np.ndarray, log: bool) -> np.ndarray:
    """Borders of the cells around ``values``."""
    inner = np.log(values) if log else values
    middle = (inner[1:] + inner[:-1]) / 2
    edges = np.concatenate([[2 * inner[0] - middle[0]], middle, [2 * inner[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def write_study(directory: Path, study: Study, findings: Findings, what: Sequence[str]) -> Path:
    """Write ``study.json``, a PNG per map, and ``study.html`` into ``directory``; returns the page's path.

    what: lines that say what was run.
    """
    directory.mkdir(parents=True, exist_ok=True)
    record = json.dumps(findings.record(), indent=1, ensure_ascii=False)
    (directory / "study.json").write_text(record, encoding="utf-8")
    body = ["<p>" + html.escape(f"{study.title}: {study.summary}") + "</p>"]
    for claim in findings.claims:
        items = "".join(f"<li>{html.escape(number)}</li>" for number in claim.numbers)
        body.append(f"<p>{html.escape(claim.claim)} <b>It {claim.verdict} here.</b></p><ul>{items}</ul>")
    for field in findings.fields:
        figure = draw(field)
        figure.savefig(directory / f"{field.name}.png", dpi=150)
        body.append(picture(field.title, field.caption, encoded(figure)))
    for table in findings.tables:
        head = "".join(f"<th>{html.escape(text)}" for text in table.head)
        rows = "".join("<tr>" + "".join(f"<td>{html.escape(t)}</td>" for t in row) + "</tr>" for row in table.rows)
        body.append(f"<h2>{html.escape(table.title)}</h2><div class=wide><table><tr>{head}</tr>{rows}</table></div>")
    body.append("<h2>What was run</h2><ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in what) + "</ul>")
    path = directory / "study.html"
    path.write_text(document(study.title, "\n".join(body)), encoding="utf-8")
    return path
