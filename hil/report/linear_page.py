"""The report of a linearisation: modes in a table, eigenvalues, and how they move with a quantity."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hil.lab.quantity import Quantity
from hil.report.html import document, folded, picture, told, verdict
from hil.report.margin_page import display_unit, search_end
from hil.report.plots import encoded

_FASTEST = 60.0  # 1/s: what fades faster is not drawn in the plot of growth and frequency
_ROWS = 30


def sentences(record: Mapping[str, Any], quantity: Quantity | None) -> list[str]:
    """What was found, for a person, a line each."""
    mode, change = record["dominant"], record["convergence"]
    lines = [
        f"loop        {record['states']} states, {1e3 * record['period']:.4g} ms per period, data under way for "
        f"{record['memory']} of them",
        f"dominant    {_told(mode)}",
        f"converged   half the displacements move modes by {change['growth']:.2g}/s in growth, "
        f"{change['angular_frequency']:.2g} rad/s in frequency" + _size_told(change["scale"]),
    ]
    prediction = record.get("prediction")
    doubt = record["doubt"] or (None if prediction is None else prediction["doubt"])
    if doubt is not None:
        lines.append(f"caution     {doubt}")
    if prediction is not None and quantity is not None:
        if prediction["predicted"] is not None:
            value = quantity.shown(prediction["predicted"])
            lines += [
                f"predicted   {quantity.key} = {value}: there the loop becomes unstable",
                f"by          {_told(prediction['mode'])}",
            ]
        elif prediction["mode"] is not None:
            lines.append(f"predicted   none: unstable from the start, by {_told(prediction['mode'])}")
        else:
            furthest = quantity.shown(prediction["furthest"])
            lines.append(f"predicted   none: the linear loop is stable up to {furthest}, {search_end(prediction)}")
    return lines


def _size_told(scale: float) -> str:
    return "" if scale == 1.0 else f"; displacements of {scale:g} of their usual size leave least noise"


def _told(mode: Mapping[str, Any]) -> str:
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in list(mode["participation"].items())[:3])
    pace = f"{abs(mode['growth']):.3g}/s {'growing' if mode['growth'] >= 0 else 'fading'}"
    wave = f" at {mode['frequency']:.2f} Hz" if mode["frequency"] > 0 else ""
    return f"{pace}{wave} ({shares})"


def draw_eigenvalues(record: Mapping[str, Any]) -> Any:
    """The z-plane with the unit circle, and growth over frequency of what fades slowly."""
    figure, (plane, slow) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
    values = np.array([complex(*mode["eigenvalue"]) for mode in record["modes"]])
    turn = np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 400))
    plane.plot(turn.real, turn.imag, color="tab:red", linewidth=1.0, label="limit of stability")
    still = np.array([mode["still"] for mode in record["modes"]])
    inside = np.abs(values) < 1.0
    for chosen, marker, colour in (
        (inside & ~still, ".", "tab:blue"), (~inside & ~still, "x", "tab:red"), (still, ".", "tab:gray"),
    ):  # fmt: skip
        both = np.concatenate([values[chosen], values[chosen].conj()])
        plane.plot(both.real, both.imag, marker, color=colour, markersize=5)
    plane.set(xlabel="Re λ [1]", ylabel="Im λ [1]", aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    plane.set_title(f"over one period, {1e3 * record['period']:.4g} ms", fontsize=9)
    plane.legend(fontsize=8, loc="lower left")
    shown = [mode for mode in record["modes"] if mode["growth"] > -_FASTEST and mode["frequency"] < 60.0]
    slow.axvline(0.0, color="tab:red", linewidth=1.0)
    for moves, colour, label in ((True, "tab:blue", None), (False, "tab:gray", "drifts slowly, if at all")):
        kind = [mode for mode in shown if mode["still"] != moves]
        slow.plot([m["growth"] for m in kind], [m["frequency"] for m in kind], ".", color=colour, markersize=7,
                  label=label)  # fmt: skip
    slow.legend(fontsize=8, loc="upper left")
    named: dict[str, Mapping[str, Any]] = {}
    for mode in shown:
        if mode["frequency"] > 0.5 and len(named) < 6:
            named.setdefault(next(iter(mode["participation"])), mode)
    for mode in named.values():
        slow.annotate(
            next(iter(mode["participation"])), (mode["growth"], mode["frequency"]), fontsize=7,
            xytext=(4, 4), textcoords="offset points",
        )  # fmt: skip
    slow.set(xlabel="growth [1/s]", ylabel="frequency [Hz]", ylim=(-1.0, None), xlim=(-_FASTEST, None))
    slow.margins(x=0.15)
    for axes in (plane, slow):
        axes.grid(alpha=0.3)
    return figure


def draw_path(prediction: Mapping[str, Any], quantity: Quantity) -> Any:
    """Size of the dominant eigenvalue, as growth, over the quantity; where it crosses."""
    path = prediction["path"]
    scale, unit = display_unit(quantity, [step["value"] for step in path])
    figure, axes = plt.subplots(figsize=(9, 3.4), layout="constrained")
    values, growth = [step["value"] * scale for step in path], [step["growth"] for step in path]
    axes.axhline(0.0, color="tab:red", linewidth=1.0, label="limit of stability")
    axes.plot(values, growth, "o", color="tab:blue", markersize=5, label="dominant mode")
    if prediction["mode"] is not None:
        followed, wave = [step["followed"] for step in path], prediction["mode"]["frequency"]
        axes.plot(values, followed, ".-", color="k", linewidth=0.8, label=f"the mode that crosses, at {wave:.1f} Hz")
    if prediction["predicted"] is not None:
        label = f"predicted {quantity.shown(prediction['predicted'])}"
        axes.axvline(prediction["predicted"] * scale, color="tab:purple", linestyle="--", label=label)
    last = max(path, key=lambda step: abs(step["value"] - path[0]["value"]))
    if last["growth"] > 0.0:
        at = (last["value"] * scale, last["growth"])
        text = f"{last['frequency']:.1f} Hz"
        axes.annotate(text, at, fontsize=8, xytext=(-6, -12), textcoords="offset points", ha="right")
    axes.set(xlabel=f"{quantity.key}{f' [{unit}]' if unit else ''}", ylabel="growth ln|λ| / period [1/s]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def write_linear(directory: Path, record: Mapping[str, Any], quantity: Quantity | None) -> Path:
    """Write ``linearise.json``, ``eigenvalues.png``, with a prediction ``path.png``, and ``linearise.html`` into
    ``directory``; returns the page's path."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "linearise.json").write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
    figure = draw_eigenvalues(record)
    figure.savefig(directory / "eigenvalues.png", dpi=150)
    pictures = picture(
        "Eigenvalues", "Left all of them, right those that fade slowly; a complex pair is drawn once there, named by "
        "what takes part most.", encoded(figure),
    )  # fmt: skip
    prediction = record.get("prediction")
    if prediction is not None and quantity is not None:
        figure = draw_path(prediction, quantity)
        figure.savefig(directory / "path.png", dpi=150)
        caption = "Growth of the dominant mode of the linear loop; above zero it is unstable."
        pictures += picture(f"Along {quantity.key}", caption, encoded(figure))
    rows = "".join(
        f"<tr><td class=n>{mode['growth']:.2f}</td><td class=n>{mode['frequency']:.2f}</td>"
        f"<td class=n>{mode['damping']:.3f}</td><td class=text>"
        + html.escape(", ".join(f"{n} {100 * s:.0f} %" for n, s in list(mode["participation"].items())[:5]))
        + "</td></tr>"
        for mode in record["modes"][:_ROWS]
    )
    stable = record["growth"] < 0.0
    body = f"""{verdict("stable" if stable else "unstable", "the linear loop at " + f"{record['at']:g} s")}
<p>{html.escape(record["scenario"])} without dry friction, noise and rounding.</p>
{told(sentences(record, quantity))}
{pictures}
<h2>Modes</h2>
<div class=wide><table><tr><th>growth [1/s]<th>frequency [Hz]<th>damping ratio<th>takes part</tr>{rows}</table></div>
{folded("All numbers", json.dumps(record, indent=1))}"""
    path = directory / "linearise.html"
    path.write_text(document(f"{record['scenario']}: modes of the closed loop", body), encoding="utf-8")
    return path
