"""What the frames of a run waited for on their buses, by identifier, beside the bound of the response-time analysis."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

from hil.analysis.message_set import analyse, traffic
from hil.scenario import Scenario
from robots import description

_PERCENTILES = (50, 99)


def bus_statistics(wires: Sequence[Any], scenario: Scenario) -> dict[str, Any]:
    """By bus and identifier: frames sent, lost and retransmitted, waiting times and their bound, longest frame; in s.

    Waiting is from being queued to the start of the attempt that succeeded. The bound is for the scenario's own
    traffic without faults, None where there is none; ``other_traffic`` tells that there was more.
    """
    robot = description.load(scenario.robot)
    found = {}
    for wire, bus in zip(wires, robot.buses, strict=True):
        sent = traffic(scenario, robot, bus)
        bounds = {r.message.name: r for r in analyse(sent, scenario.bus[bus.name])}
        listed = {(t.identifier, t.extended): bounds[t.name] for t in sent}
        rows = []
        for key, one in wire.traffic().items():
            wait = one.wait
            bound = listed.get(key)
            row = {
                "identifier": key[0],
                "extended": key[1],
                "name": None if bound is None else bound.message.name,
                "sent": one.sent,
                "lost": one.lost,
                "retransmitted": one.retransmitted,
                **{f"wait_p{q}": wait.percentile(q) / 1e9 for q in _PERCENTILES},
                "wait_max": wait.longest / 1e9,
                "frame": None if bound is None else bound.message.frame / 1e9,
                "wait_bound": None,
            }
            if bound is not None and bound.from_queue is not None:
                row["wait_bound"] = (bound.from_queue - bound.message.frame) / 1e9
            rows.append(row)
        found[bus.name] = {
            "other_traffic": any(row["name"] is None for row in rows),
            "errors": wire.errors,
            "identifiers": rows,
        }
    return found


def statistics_table(statistics: Mapping[str, Any]) -> str:
    """HTML of ``bus_statistics``."""

    def us(value: float | None) -> str:
        return f"<td class=n>{'–' if value is None else f'{1e6 * value:.1f}'}</td>"

    rows = []
    for name, bus in statistics.items():
        doubts = [f"{bus['errors']} errors"] * bool(bus["errors"]) + ["other traffic"] * bus["other_traffic"]
        note = f": {' and '.join(doubts)}, which the bounds do not count" if doubts else ""
        rows.append(f"<tr><th colspan=10>{html.escape(name.replace('_', ' '))}{note}</th></tr>")
        for row in bus["identifiers"]:
            bound = row["wait_bound"]
            beyond = " class=beyond" if bound is not None and row["wait_max"] > bound else ""
            rows.append(
                f"<tr{beyond}><td>{row['identifier']:#05x}</td><td>{html.escape(row['name'] or 'other')}</td>"
                + "".join(f"<td class=n>{row[key]}</td>" for key in ("sent", "lost", "retransmitted"))
                + "".join(us(row[key]) for key in ("wait_p50", "wait_p99", "wait_max", "wait_bound", "frame"))
                + "</tr>"
            )
    head = "".join(f"<th>{text}</th>" for text in (
        "id", "", "sent", "lost", "sent again", "wait p50 [µs]", "p99", "longest", "bound", "longest frame"
    ))  # fmt: skip
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"
