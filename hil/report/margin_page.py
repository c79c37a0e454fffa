"""The report of a margin: what was found in words, a picture of every run, and the table behind it."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from hil.lab.kept import STABLE, UNSTABLE, section
from hil.lab.margin import boundary_pair
from hil.lab.quantity import Quantity
from hil.report.html import document, folded, picture, told
from hil.report.plots import encoded
from hil.scenario import to_toml


def sentences(result: Mapping[str, Any], quantity: Quantity) -> list[str]:
    """What was found, for a person, a line each: name, blanks, text."""
    shown, seeds = quantity.shown, result["per_seed"]
    n = len(seeds)
    lines = []
    if result["margin"] is not None:
        whose = f"the median of {n} seeds" if n > 1 else "of one seed, which tells nothing about others"
        lines.append(f"margin      {shown(result['margin'])}, {whose}")
    elif result["open"] > n // 2:
        lines.append(f"margin      none found: stable up to {shown(result['stable_to'])}, where the search ended")
    else:
        lines.append(f"margin      none: unstable at {shown(seeds[0]['tried'][0]['value'])} already")
    interval = result["interval"]
    if n > 1:
        low, high = (("beyond" if end is None else shown(end)) for end in (interval["low"], interval["high"]))
        if interval["low"] is None:
            low = "unstable from the start"
        if interval["high"] is None:
            high = "beyond the search"
        lines.append(
            f"confidence  {low} to {high} holds the median of all seeds with {100 * interval['confidence']:.3g} % "
            "(order statistics)"
        )
    lines.append(f"by seed     {', '.join(_of_seed(seed, quantity) for seed in seeds)}")
    if result["open"] and result["margin"] is not None:
        lines.append(f"            {result['open']} of them stable as far as was looked")
    if result["unstable_at_start"] and result["margin"] is not None:
        lines.append(f"            {result['unstable_at_start']} of them unstable from the start")
    if result.get("predicted") is not None:
        lines.append(f"predicted   {shown(result['predicted'])}, of the linear loop")
    elif "predicted" in result:
        lines.append(f"predicted   none: the linear loop is {_unpredicted(result['linear'], quantity)}")
    if result.get("doubt") is not None:
        lines.append(f"            {result['doubt']}")
    if result.get("parting") is not None:
        lines.append(f"            {result['parting']}")
    return lines


def _unpredicted(linear: Mapping[str, Any], quantity: Quantity) -> str:
    """Why a search of the linear loop's boundary found none."""
    if linear["mode"] is not None:
        return "unstable from the start"
    return f"stable up to {quantity.shown(linear['furthest'])}, {search_end(linear)}"


def search_end(linear: Mapping[str, Any]) -> str:
    """Why a prediction that found no boundary looked no further."""
    return "where the search ended" if linear["refused"] is None else f"no further looked at: {linear['refused']}"


def _of_seed(seed: Mapping[str, Any], quantity: Quantity) -> str:
    if seed["stable"] is None:
        return "–"
    return quantity.shown(seed["stable"]) + (" or beyond" if seed["unstable"] is None else "")


def draw_margin(result: Mapping[str, Any], quantity: Quantity) -> Any:
    """Verdict of every run over its value, a row per seed; median and interval drawn in."""
    scale, unit = display_unit(quantity, [run["value"] for seed in result["per_seed"] for run in seed["tried"]])
    figure, axes = plt.subplots(figsize=(9, 2.1 + 0.35 * len(result["per_seed"])), layout="constrained")
    interval = result["interval"]
    ends = [result["interval"][end] for end in ("low", "high")]
    if None not in ends and interval["confidence"] > 0:
        label = f"{100 * interval['confidence']:.3g} % interval of the median"
        axes.axvspan(ends[0] * scale, ends[1] * scale, color="tab:blue", alpha=0.15, label=label)
    if result["margin"] is not None:
        axes.axvline(result["margin"] * scale, color="tab:blue", label=f"margin {quantity.shown(result['margin'])}")
    if result.get("predicted") is not None:
        label = f"predicted {quantity.shown(result['predicted'])}"
        axes.axvline(result["predicted"] * scale, color="tab:purple", linestyle="--", label=label)
    for stable, marker, colour, label in ((True, "o", "tab:green", "stable"), (False, "x", "tab:red", "not stable")):
        points = [
            (run["value"] * scale, seed["seed"])
            for seed in result["per_seed"] for run in seed["tried"] if run["stable"] == stable
        ]  # fmt: skip
        if points:
            axes.plot(*zip(*points, strict=True), marker, color=colour, markersize=6, label=label)
    axes.set(xlabel=f"{quantity.key}{f' [{unit}]' if unit else ''}", ylabel="seed")
    axes.set_yticks([seed["seed"] for seed in result["per_seed"]])
    axes.margins(y=0.25)
    axes.grid(alpha=0.3, axis="x")
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    return figure


def display_unit(quantity: Quantity, values: list[float]) -> tuple[float, str]:
    """Factor and unit in which ``values`` read well."""
    largest = max((abs(value) for value in values), default=0.0)
    if quantity.unit == "s" and 0 < largest < 1:
        return (1e3, "ms") if largest >= 1e-3 else (1e6, "µs")
    return 1.0, quantity.unit


def write_margin(directory: Path, result: Mapping[str, Any], quantity: Quantity) -> Path:
    """Write ``margin.json``, ``margin.png`` and ``margin.html`` into ``directory``; returns the page's path."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "margin.json").write_text(json.dumps(result, indent=1, allow_nan=False), encoding="utf-8")
    figure = draw_margin(result, quantity)
    figure.savefig(directory / "margin.png", dpi=150)
    when = "" if result["at"] is None else f", changed at {result['at']:g} s"
    rows = "".join(
        f"<tr><td class=n>{seed['seed']}</td><td class=n>{quantity.shown(run['value'])}</td>"
        f"<td>{'stable' if run['stable'] else 'unstable'}</td><td class=text>{html.escape(run['reason'])}</td></tr>"
        for seed in result["per_seed"] for run in sorted(seed["tried"], key=lambda run: run["value"])
    )  # fmt: skip
    pair = boundary_pair(result, quantity)
    sides = (
        {}
        if pair is None
        else {
            STABLE: f"{quantity.shown(pair.stable[quantity])}, seed {pair.seed}: stable",
            UNSTABLE: f"{quantity.shown(pair.unstable[quantity])}, seed {pair.seed}: unstable",
        }
    )
    numbers = {name: value for name, value in result.items() if name != "configuration"}
    body = f"""<p>{html.escape(result["scenario"])}{when}; nominal {quantity.shown(quantity.nominal)}</p>
{told(sentences(result, quantity))}
{section(directory, sides)}
{picture("Every run", "Bisection: each seed is tried where its own boundary was not yet known.", encoded(figure))}
<div class=wide><table><tr><th>seed<th>{html.escape(quantity.key)}<th>verdict<th>reason</tr>{rows}</table></div>
{folded("Exact configuration, a scenario file", to_toml(result["configuration"]))}
{folded("All numbers", json.dumps(numbers, indent=1))}"""
    path = directory / "margin.html"
    path.write_text(document(f"Margin of {quantity.key}", body), encoding="utf-8")
    return path
