"""``hil map DIR``: the stability map of a sweep over two axes, as a page and as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hil.errors import EXIT_STABLE, UserError


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("map", help="draw the stability map of a sweep over two axes")
    parser.add_argument("directory", type=Path, metavar="DIR", help="of the sweep; gets map.html and map.png")
    parser.add_argument("--x", metavar="KEY", help="the axis to the right (default: the first)")
    parser.add_argument("--y", metavar="KEY", help="the axis upwards (default: the next)")
    parser.add_argument(
        "--where", action="append", default=[], metavar="KEY=VALUE", help="hold a further axis at one of its values"
    )
    parser.set_defaults(command=_map)


def _map(options: argparse.Namespace) -> int:
    from hil.lab.extras import require
    from hil.lab.stability_map import load_map
    from hil.report.map_page import caption, write_map

    require("pyarrow.parquet", "plotly")
    where = {}
    for text in options.where:
        key, separator, value = text.partition("=")
        if not separator or not key or not value:
            raise UserError(f"--where {text}: expected KEY=VALUE")
        where[key] = value
    found = load_map(options.directory, options.x, options.y, where)
    print(caption(found))
    print(f"map         {write_map(options.directory, found)}")
    return EXIT_STABLE
