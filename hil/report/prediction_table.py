"""What the linear loop predicts beside what runs found, as a table for a page and as lines for a terminal."""

from __future__ import annotations

import html
from collections.abc import Sequence

from hil.lab.linear.agreement import Agreement
from hil.lab.quantity import Quantity


def prediction_table(rows: Sequence[Agreement], along: Quantity, across: Quantity | None) -> str:
    """HTML, a row per value of ``across``."""
    head = "" if across is None else f"<th>{html.escape(across.key)}"
    lines = "".join(
        ("<tr>" if across is None else f"<tr><td class=n>{html.escape(across.shown(_known(row.across)))}</td>")
        + f"<td class=n>{_told(row.measured, along)}</td><td class=n>{_told(row.predicted, along)}</td>"
        + f"<td class=text>{html.escape(_mode(row))}</td><td class=text>{html.escape(row.sentence)}</td></tr>"
        for row in rows
    )
    return (
        f"<h2>Predicted by the linear loop</h2><p class=caption>Where {html.escape(along.key)} makes it unstable: "
        "half of the runs, and the linearised loop without dry friction and noise.</p>"
        f"<div class=wide><table><tr>{head}<th>runs<th>predicted<th>what grows<th>where they part</tr>"
        f"{lines}</table></div>"
    )


def prediction_lines(rows: Sequence[Agreement], along: Quantity, across: Quantity | None) -> list[str]:
    """One line per row."""
    return [
        ("" if across is None else f"{across.key} {across.shown(_known(row.across))}: ")
        + f"runs {_told(row.measured, along)}, predicted {_told(row.predicted, along)}: {row.sentence}"
        for row in rows
    ]


def _known(value: float | None) -> float:
    assert value is not None
    return value


def _told(value: float | None, quantity: Quantity) -> str:
    return "–" if value is None else html.escape(quantity.shown(value))


def _mode(row: Agreement) -> str:
    return row.mode if row.frequency is None else f"{row.frequency:.1f} Hz: {row.mode}"
