"""The report of a run: one self-contained page."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.signals import Signals

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:60rem;padding:1rem;color:#1a1a1a}
h1{font-size:1.5rem}h2{font-size:1.1rem;margin-top:2rem}img{width:100%;height:auto}
.stable{background:#e3f4e4;border-left:.5rem solid #2e8b3a}.unstable,.failed{background:#fbe5e3;border-left:.5rem solid #c0392b}
.verdict{padding:.7rem 1rem;font-size:1.1rem}table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:left;
border-bottom:1px solid #ddd}td.n{text-align:right;font-variant-numeric:tabular-nums}pre{overflow-x:auto;font-size:.8rem}
@media print{details{display:none}img{break-inside:avoid}}
"""


def _row(name: str, value: float | None, scale: float, unit: str, limit: str = "") -> str:
    number = "–" if value is None else f"{value * scale:.4g}"
    return f"<tr><td>{name}</td><td class=n>{number}</td><td>{unit}</td><td>{limit}</td></tr>"


def _impairments(configuration: Mapping[str, Any]) -> list[str]:
    """Every impairment of the configuration that is not zero."""
    found = []
    groups = {f"link.{k}": v for k, v in configuration["link"].items()}
    groups |= {f"bus.{k}": v for k, v in configuration["bus"].items()}
    for target, values in groups.items():
        for key in ("delay", "jitter", "loss", "bit_error_rate"):
            if values[key]:
                found.append(f"{target}.{key} = {values[key]:g}{' s' if key in ('delay', 'jitter') else ''}")
    found += [
        f"push of {push['force']} N at {push['at']:g} s for {push['duration']:g} s" for push in configuration["push"]
    ]
    return found


def write_report(directory: Path, record: Mapping[str, Any], tables: Mapping[str, Signals]) -> Path:
    """Write ``report.html`` into ``directory`` and return its path."""
    from hil.plots import draw

    metrics, limits = record["metrics"], record["configuration"]["limits"]
    rows = [
        _row("CoM error, largest", metrics.get("com_error_max"), 1e3, "mm", f"limit {1e3 * limits['com_error']:g}"),
        _row("CoM error, rms", metrics.get("com_error_rms"), 1e3, "mm"),
        _row("internal force, error of the sensed", metrics.get("internal_force_error"), 100, "% of reference"),
        _row("internal force, error of the true", metrics.get("internal_force_error_truth"), 100, "% of reference"),
        _row("internal force, sensed against true", metrics.get("internal_force_sensed_vs_truth"), 100, "% of reference"),
        _row("foot slip, largest", metrics.get("foot_slip_max"), 1e3, "mm", f"limit {1e3 * limits['foot_slip']:g}"),
        _row("friction used, largest", metrics.get("friction_used_max"), 100, "%", "limit 100"),
        _row("round trip p50", metrics.get("round_trip_p50"), 1e3, "ms"),
        _row("round trip p99", metrics.get("round_trip_p99"), 1e3, "ms", "servo period 0.667"),
        _row("real-time factor", record["realtime_factor"], 1, ""),
    ]
    injected = _impairments(record["configuration"])
    injected += [f"{i['key']} = {i['value']} from {i['time_s']:.3f} s on" for i in record["injected"]]
    items = "".join(f"<li>{html.escape(text)}</li>" for text in injected) or "<li>nothing</li>"
    plots = "".join(
        f'<h2>{html.escape(title)}</h2><img alt="{html.escape(title)}" src="data:image/png;base64,{data}">'
        for title, data in draw(record, tables)
    )
    title = f"{record['scenario']}, seed {record['seed']}"
    page = f"""<!doctype html><html lang=en><meta charset=utf-8>
<meta name=viewport content="width=device-width,initial-scale=1"><title>{html.escape(title)}</title><style>{_STYLE}</style>
<h1>{html.escape(title)}</h1>
<p>{record['backend']} backend, {record['clock']} clock, {record['simulated_time']:.2f} s simulated,
digest <code>{record['log_digest'][:16]}</code></p>
<p class="verdict {record['verdict']}"><b>{record['verdict']}</b>: {html.escape(record['reason'])}</p>
<h2>Key numbers</h2><table>{''.join(rows)}</table>
<h2>Injected</h2><ul>{items}</ul>{plots}
<details><summary>Exact configuration, versions and metrics</summary>
<pre>{html.escape(json.dumps({k: record[k] for k in ('configuration', 'versions', 'metrics')}, indent=1))}</pre></details>
"""
    path = directory / "report.html"
    path.write_text(page, encoding="utf-8")
    return path
