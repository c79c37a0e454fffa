"""The report of a run: one self-contained page."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.analysis.numbers import Number, key_numbers
from hil.record.signals import Signals
from hil.report.html import BEYOND, Link, document, film, folded, picture, verdict
from robots import description


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
    """A row per number; one beyond its limit stands out."""
    numbers = [*key_numbers(record["metrics"], record["configuration"])]
    numbers.append(Number("real-time factor", record["realtime_factor"]))
    rows = "".join(
        f"<tr{BEYOND if n.beyond else ''}><td>{html.escape(n.name)}</td><td class=n>{n.shown}</td>"
        f"<td>{n.unit}</td><td>{n.bound}</td></tr>"
        for n in numbers
    )
    return f"<div class=wide><table>{rows}</table></div>"


def _came_first(record: Mapping[str, Any], directory: Path) -> str:
    """What began before the run failed, in order; nothing for one that is stable."""
    signs = record.get("came_first")
    if not signs:
        return ""
    from hil.analysis.causes import Sign  # slow to import
    from hil.record.ring import LAST_SECONDS_FILE

    items = "".join(f"<li>{html.escape(str(Sign(**sign)))}</li>" for sign in signs)
    file = ""
    if (directory / LAST_SECONDS_FILE).exists():
        file = f'<p>The last seconds, every physics step: <a href="{LAST_SECONDS_FILE}">{LAST_SECONDS_FILE}</a></p>'
    return f"<h2>What came first</h2><ol>{items}</ol>{file}"


def write_report(
    directory: Path, record: Mapping[str, Any], tables: Mapping[str, Signals], part_of: Link | None = None
) -> Path:
    """Write ``report.html`` into ``directory`` and return its path. ``part_of``: the page that the run belongs to."""
    from hil.analysis.bus_statistics import statistics_table
    from hil.report.last_seconds import draw_last_seconds
    from hil.report.plots import draw
    from hil.report.stepping import draw_stepping
    from hil.scenario import to_toml

    injected = _faults(record["configuration"])
    injected += [f"{i['key']} = {i['value']} from {i['time_s']:.3f} s on" for i in record["injected"]]
    items = "".join(f"<li>{html.escape(text)}</li>" for text in injected) or "<li>nothing</li>"
    plots = "".join(picture(*plot) for plot in draw(record, tables, directory))
    plots += "".join(picture(*plot) for plot in draw_stepping(record, tables))
    robot = description.load(record["configuration"]["robot"])
    plots += "".join(picture(*plot) for plot in draw_last_seconds(directory, tables, robot))
    title = f"{record['scenario']}, seed {record['seed']}"
    about = html.escape(record["configuration"]["description"])
    rest = json.dumps({key: record[key] for key in ("versions", "metrics")}, indent=1)
    settle = record["configuration"]["limits"]["settle"]
    configuration = to_toml(record["configuration"])
    simulated = f"{record['simulated_time']:.2f} s simulated"
    body = f"""<p>{about}<br>{record["backend"]} backend, {record["clock"]} clock, {simulated},
digest <code>{record["log_digest"][:16]}</code></p>
{verdict(record["verdict"], record["reason"])}
{film(directory)}{_came_first(record, directory)}<h2>Injected</h2><ul>{items}</ul>
<h2>Key numbers</h2><p class=caption>From {settle:g} s on (grey in the plots: settling).
Dash-dotted lines: injections while it ran.</p>{_numbers(record)}{plots}
<h2>Waiting for the bus</h2><p class=caption>From the transmit queue to the start of the frame, beside the bound of
response-time analysis for any offsets. After it comes the frame itself.</p>{statistics_table(record["bus"])}
{folded(f"Exact configuration, a scenario file: --seed {record['seed']} repeats the run", configuration)}
{folded("Versions and all metrics", rest)}"""
    path = directory / "report.html"
    path.write_text(document(title, body, part_of), encoding="utf-8")
    return path
