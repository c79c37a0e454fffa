"""``hil map DIR``: what a sweep found, as a page and as a picture: along one axis a line, over two axes a map."""

from __future__ import annotations

import argparse
import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import EXIT_STABLE, UserError

if TYPE_CHECKING:
    from hil.lab.linear.agreement import Agreement
    from hil.lab.places import Places
    from hil.lab.quantity import Quantity

_SETTLED = 5.0  # s: the linear loop is that of a robot that stands, whenever the sweep's values change
_ROWS = 9  # of a predicted curve, if the sweep has fewer


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("map", help="draw a sweep: along one axis, or the stability map over two")
    parser.add_argument("directory", type=Path, metavar="DIR", help="of the sweep; gets map.html and map.png")
    parser.add_argument("--x", metavar="KEY", help="the axis to the right (default: the first)")
    parser.add_argument("--y", metavar="KEY", help="the axis upwards (default: the next)")
    parser.add_argument(
        "--where", action="append", default=[], metavar="KEY=VALUE", help="hold a further axis at one of its values"
    )
    parser.add_argument(
        "--predict",
        action="store_true",
        help="draw where the linearised loop becomes unstable, and tell why that differs",
    )
    parser.add_argument(
        "--keep", action="store_true", help="run both sides of the boundary again, once each, and keep their records"
    )
    parser.add_argument("--video", action="store_true", help="--keep, with their videos")
    parser.add_argument("--json", action="store_true", help="print one JSON object, SI units, and nothing else")
    parser.set_defaults(command=_map)


def _map(options: argparse.Namespace) -> int:
    from hil.lab.extras import require
    from hil.lab.places import places
    from hil.lab.stability_map import map_places

    require("pyarrow.parquet", "plotly")
    if options.video:
        from hil.report.video import require_rendering

        require_rendering()
    where = _where(options.where)
    along_one = options.y is None and len(places(options.directory, (), where).quantities) == 1
    if along_one:
        _line(options, where)
    else:
        _plane(options, map_places(options.directory, options.x, options.y, where))
    return EXIT_STABLE


def _where(texts: list[str]) -> dict[str, str]:
    where = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if not separator or not key or not value:
            raise UserError(f"--where {text}: expected KEY=VALUE")
        where[key] = value
    return where


def _line(options: argparse.Namespace, where: dict[str, str]) -> None:
    from hil.lab.stability_line import line_of, line_places
    from hil.report.line_page import record, sentences, write_line

    sweep = line_places(options.directory, options.x, where)
    found = line_of(sweep)
    predicted: float | None = None
    rows: list[Agreement] = []
    if options.predict:
        predicted, rows = _predicted_along(sweep)
    page = write_line(options.directory, found, predicted, _more(options, sweep, rows, found.quantity, None))
    _tell(options, sentences(found), rows, found.quantity, None, dict(record(found)), page)


def _plane(options: argparse.Namespace, sweep: Places) -> None:
    from hil.lab.stability_map import map_of
    from hil.report.map_page import caption, write_map

    found = map_of(sweep)
    curves: list[Any] = []
    rows: list[Agreement] = []
    along, across = found.x_quantity, found.y_quantity
    if options.predict:
        curves, rows, along, across = _predicted_over(sweep)
    page = write_map(options.directory, found, curves, _more(options, sweep, rows, along, across))
    record = {
        "scenario": found.scenario,
        "x": found.x_quantity.key,
        "y": found.y_quantity.key,
        "places": [
            {"x": x, "y": y, "share": share, "runs": runs, "decided": decided, "reason": reason}
            for x, y, share, runs, decided, reason in zip(
                found.x.tolist(), found.y.tolist(), found.share.tolist(), found.runs.tolist(), found.decided.tolist(),
                found.reasons, strict=True,
            )
        ],
        "confidence": found.confidence,
    }  # fmt: skip
    _tell(options, [caption(found)], rows, along, across, record, page)


def _predicted_along(sweep: Places) -> tuple[float | None, list[Agreement]]:
    """Where the linear loop becomes unstable along the only axis, and how that fits what runs found."""
    from hil.lab.linear.agreement import agreement
    from hil.lab.linear.curve import critical, remembered, sides
    from hil.lab.linear.operating_point import OperatingPoint

    along = sweep.quantities[0]
    _check(along)
    scenario = _held(sweep)
    values = [float(place[0]) for place in sweep.rows]
    rows = []
    with OperatingPoint(scenario, max(sweep.at, _SETTLED)) as point:
        for start, end in sides(along, min(values), max(values)):
            loop = remembered(lambda value: point.with_value(along, value), along)
            found = critical(loop, 0.0, along, start, end)
            rows.append(agreement(sweep, along, list(sweep.rows), start, end, found, across=False))
    return next((row.predicted for row in rows if row.predicted is not None), None), rows


def _predicted_over(sweep: Places) -> tuple[list[Any], list[Agreement], Quantity, Quantity]:
    """Predicted boundaries over two axes, and row by row how they fit what runs found."""
    import numpy as np

    from hil.lab.linear.agreement import agreements
    from hil.lab.linear.curve import predicted_curves
    from hil.report.progress import Counter

    x, y = sweep.quantities
    swapped = y.injectable and not x.injectable  # along what changes in a robot that stands: that is quick
    along, across = (y, x) if swapped else (x, y)
    for q in (along, across):
        _check(q)
    columns = [sorted({float(place[n]) for place in sweep.rows}) for n in ((1, 0) if swapped else (0, 1))]
    rows = columns[1]
    log = sweep.logs[0 if swapped else 1]
    if not sweep.grid:
        spread = np.geomspace if log else np.linspace
        rows = spread(rows[0], rows[-1], _ROWS).tolist()
    elif across.kind != "integer" and len(rows) > 1:
        rows = _between(rows, log, -(-(_ROWS - 1) // (len(rows) - 1)))
    scenario = _held(sweep)
    with Counter("the linear loop", 8 * len(rows), "linearisations", sys.stderr) as progress:
        curves = predicted_curves(
            scenario, max(sweep.at, _SETTLED), along, columns[0][0], columns[0][-1], across, rows, progress.show
        )
    told = [row for curve in curves for row in agreements(sweep, curve)] if sweep.grid else []
    return [part for curve in curves for part in curve.segments(not swapped)], told, along, across


def _between(values: list[float], log: bool, parts: int) -> list[float]:
    """``values``, and more of them between, so that each gap has ``parts``."""
    import numpy as np

    found = [values[0]]
    for low, high in pairwise(values):
        inner = (np.geomspace if log else np.linspace)(low, high, parts + 1)[1:-1]
        found += [*inner.tolist(), high]
    return found


def _check(quantity: Quantity) -> None:
    if not quantity.numeric:
        raise UserError(f"--predict: {quantity.key} is no number; there is nothing to follow along it")


def _held(sweep: Places) -> Any:
    from hil.lab.quantity import changed

    fixed = {q.key: q.written(value) for q, value in sweep.held.items()}
    return changed(sweep.scenario, fixed) if fixed else sweep.scenario


def _more(
    options: argparse.Namespace, sweep: Places, rows: list[Agreement], along: Quantity, across: Quantity | None
) -> str:
    """What the page says below the drawing."""
    import html

    from hil.lab.kept import STABLE, UNSTABLE, keep, section
    from hil.report.html import Link
    from hil.report.prediction_table import prediction_table

    more = prediction_table(rows, along, across) if rows else ""
    pair = sweep.pair()
    if pair is None:
        return more
    if options.keep or options.video:
        page = Link("map.html", f"the sweep over {', '.join(q.key for q in sweep.quantities)}")
        keep(options.directory, sweep.scenario, sweep.at, pair, page, options.video)
    told = {
        name: ", ".join(f"{q.key} = {q.shown(value)}" for q, value in values.items()) + f", seed {pair.seed}: {name}"
        for name, values in ((STABLE, pair.stable), (UNSTABLE, pair.unstable))
    }
    kept = section(options.directory, told)
    hint = f"hil map {options.directory} --video"
    return more + (kept or f"<p class=caption>Either side of the boundary as runs to look at: {html.escape(hint)}</p>")


def _tell(
    options: argparse.Namespace, lines: list[str], rows: list[Agreement], along: Quantity, across: Quantity | None,
    record: dict[str, Any], page: Path,
) -> None:  # fmt: skip
    from hil.report.prediction_table import prediction_lines

    record["predicted"] = [row.record() for row in rows]
    record["along"], record["across"] = along.key, None if across is None else across.key
    (page.parent / "map.json").write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
    if options.json:
        print(json.dumps({**record, "page": str(page)}, allow_nan=False))
        return
    for line in [*lines, *prediction_lines(rows, along, across)]:
        print(line)
    print(f"map         {page}")
