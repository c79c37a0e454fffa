"""``hil compare A B …``: recorded runs over each other: what differs, numbers side by side, signals in one picture."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import record_directory
from hil.errors import EXIT_STABLE

if TYPE_CHECKING:
    from hil.analysis.comparison import SideBySide


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("compare", help="draw recorded runs over each other, with what differs")
    parser.add_argument("runs", type=Path, nargs="+", metavar="DIR", help="the records of two runs or more")
    parser.add_argument("--out", type=Path, metavar="NEW", help="directory of the page (default: runs/compare-…)")
    parser.add_argument("--png", action="store_true", help="write every plot as a PNG file, too")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_compare)


def _compare(options: argparse.Namespace) -> int:
    from hil.analysis.comparison import side_by_side
    from hil.report.compare_page import write_comparison

    found = side_by_side(options.runs)
    out = record_directory(options.out, f"compare-{time.strftime('%Y%m%d-%H%M%S')}")
    page = write_comparison(out, found, pictures=options.png)
    if options.json:
        print(json.dumps({**found.record(), "page": str(page)}, allow_nan=False))
        return EXIT_STABLE
    _print(found)
    print(f"report      {page}")
    return EXIT_STABLE


def _print(found: SideBySide) -> None:
    from hil.report.compare_page import signed

    letters = found.letters
    for name, run in zip(letters, found.runs, strict=True):
        print(f"{name:>3}  {run.directory}, seed {run.seed}: {run.verdict}: {run.reason}")
    print("\ndiffers" if found.differing else "\nnothing differs: repetitions of one run")
    for key, values in found.differing.items():
        print(f"  {key}: " + ", ".join(f"{v or 'nothing'} in {name}" for name, v in zip(letters, values, strict=True)))
    if found.parting is not None and found.parting.first is not None:
        print(f"\nthe first difference\n  {found.parting.first}")
    width = max(len(row.name) + len(row.unit) for row in found.rows) + 3
    print("\n" + " " * width + "".join(f"{name:>22}" for name in letters))
    for row in found.rows:
        cells = []
        for index, (number, difference) in enumerate(zip(row.numbers, row.differences, strict=True)):
            text = "–" if number is None else number.shown
            cells.append(text if index == 0 or difference is None else f"{text} ({signed(difference)})")
        name = f"{row.name} [{row.unit}]" if row.unit else row.name
        print(f"{name:<{width}}" + "".join(f"{cell:>22}" for cell in cells))
    print()
