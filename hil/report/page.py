"""The report of a run: one self-contained page."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.record.signals import Signals
from hil.report.html import document, folded, picture, verdict
from robots import description


def _row(
    name: str, value: float | None, scale: float, unit: str, limit: float | None = None, note: str = ""
) -> str:
    """A row of the table of numbers; a value beyond ``limit`` (in the value's own unit) stands out."""
    number = "–" if value is None else f"{value * scale:.4g}"
    beyond = limit is not None and value is not None and value > limit
    bound = note if limit is None else f"limit {limit * scale:.4g}{' ' + unit if unit else ''}"
    kind = ' class="beyond"' if beyond else ""
    return f"<tr{kind}><td>{name}</td><td class=n>{number}</td><td>{unit}</td><td>{bound}</td></tr>"


def _faults(configuration: Mapping[str, Any]) -> list[str]:
    """Every fault and push of the configuration."""
    from hil.injection import injectable

    found = []
    for key, entry in injectable(description.load(configuration["robot"])).items():
        value: Any = configuration
        for part in key.split("."):
            value = value.get(part, {})
        if value not in ({}, entry.default):
            amount = f"{1e3 * value:g} ms" if entry.unit == "s" else f"{_shown(value)} {entry.unit}".rstrip()
            found.append(f"{key} = {amount} from the start")
    for push in configuration["push"]:
        force = ", ".join(f"{component:g}" for component in push["force"])
        held = f"held for {push['duration']:g} s, ramps of {push['ramp']:g} s"
        found.append(f"push of ({force}) N at {push['at']:g} s, {held}")
    return found


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _numbers(record: Mapping[str, Any]) -> str:
    metrics, configuration = record["metrics"], record["configuration"]
    limits = configuration["limits"]
    tilted = metrics.get("orientation_error_max")
    period = 1e3 / configuration["controller"]["rate"]
    force = "% of the reference"
    tilt = 180.0 / math.pi
    rows = [
        _row("CoM error, largest", metrics.get("com_error_max"), 1e3, "mm", limits["com_error"]),
        _row("CoM error, rms", metrics.get("com_error_rms"), 1e3, "mm"),
        _row("torso's tilt, largest", tilted, tilt, "°", limits["orientation_error"]),
        _row("internal force, error of the sensed", metrics.get("internal_force_error"), 100, force),
        _row("internal force, error of the true", metrics.get("internal_force_error_truth"), 100, force),
        _row("internal force, sensed against true", metrics.get("internal_force_sensed_vs_truth"), 100, force),
        _row("foot slip, largest", metrics.get("foot_slip_max"), 1e3, "mm", limits["foot_slip"]),
        _row("foot without load, longest", metrics.get("contact_loss_max"), 1e3, "ms", limits["foot_lifted"]),
        _row("friction used, largest", metrics.get("friction_used_max"), 100, "%", 1.0),
        _row("round trip p50", metrics.get("round_trip_p50"), 1e3, "ms"),
        _row("round trip p99", metrics.get("round_trip_p99"), 1e3, "ms", note=f"servo period {period:.4g} ms"),
    ]
    for bus, load in (metrics.get("bus_load") or {}).items():
        lost, errors = metrics["frames_lost"][bus], metrics["bus_errors"][bus]
        name = f"load of {html.escape(bus.replace('_', ' '))}"
        rows.append(_row(name, load, 100, "%", note=f"{lost} frames lost, {errors} bus errors"))
    for name, entry in (metrics.get("oscillation") or {}).items():
        if entry is not None:
            doubt = "∞" if entry["growth_error"] is None else f"{2 * entry['growth_error']:.2g}"
            note = f"±{doubt}, at {entry['frequency']:.2g} Hz; limit {limits['growth_rate']:g} 1/s"
            rows.append(_row(f"oscillation of {name}, growth", entry["growth"], 1, "1/s", note=note))
    rows.append(_row("real-time factor", record["realtime_factor"], 1, ""))
    return f"<table>{''.join(rows)}</table>"


def _came_first(record: Mapping[str, Any], directory: Path) -> str:
    """What began before the run failed, in order; nothing for one that is stable."""
    from hil.analysis.causes import Sign
    from hil.record.ring import LAST_SECONDS_FILE

    items = "".join(f"<li>{html.escape(str(Sign(**sign)))}</li>" for sign in record.get("came_first", ()))
    if not items:
        return ""
    file = ""
    if (directory / LAST_SECONDS_FILE).exists():
        file = f'<p>The last seconds, every physics step: <a href="{LAST_SECONDS_FILE}">{LAST_SECONDS_FILE}</a></p>'
    return f"<h2>What came first</h2><ol>{items}</ol>{file}"


def write_report(directory: Path, record: Mapping[str, Any], tables: Mapping[str, Signals]) -> Path:
    """Write ``report.html`` into ``directory`` and return its path."""
    from hil.analysis.bus_statistics import statistics_table
    from hil.report.plots import draw
    from hil.scenario import to_toml

    injected = _faults(record["configuration"])
    injected += [f"{i['key']} = {i['value']} from {i['time_s']:.3f} s on" for i in record["injected"]]
    items = "".join(f"<li>{html.escape(text)}</li>" for text in injected) or "<li>nothing</li>"
    plots = "".join(picture(*plot) for plot in draw(record, tables, directory))
    title = f"{record['scenario']}, seed {record['seed']}"
    about = html.escape(record["configuration"]["description"])
    rest = json.dumps({key: record[key] for key in ("versions", "metrics")}, indent=1)
    settle = record["configuration"]["limits"]["settle"]
    configuration = to_toml(record["configuration"])
    simulated = f"{record['simulated_time']:.2f} s simulated"
    body = f"""<p>{about}<br>{record["backend"]} backend, {record["clock"]} clock, {simulated},
digest <code>{record["log_digest"][:16]}</code></p>
{verdict(record["verdict"], record["reason"])}
{_came_first(record, directory)}<h2>Injected</h2><ul>{items}</ul>
<h2>Key numbers</h2><p class=caption>From {settle:g} s on (grey in the plots: settling).
Dash-dotted lines: injections while it ran.</p>{_numbers(record)}{plots}
<h2>Waiting for the bus</h2><p class=caption>From the transmit queue to the start of the frame, beside the bound of
response-time analysis for any offsets. After it comes the frame itself.</p>{statistics_table(record["bus"])}
{folded(f"Exact configuration, a scenario file: --seed {record['seed']} repeats the run", configuration)}
{folded("Versions and all metrics", rest)}"""
    path = directory / "report.html"
    path.write_text(document(title, body), encoding="utf-8")
    return path
