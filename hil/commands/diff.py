"""``hil diff A B``: the first node, time and signal at which two recorded runs part."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

_SHOWN = 12


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("diff", help="the first node, time and signal at which two recorded runs part")
    parser.add_argument("a", type=Path, metavar="A", help="the record of a run")
    parser.add_argument("b", type=Path, metavar="B", help="the record of another")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_diff)


def _diff(options: argparse.Namespace) -> int:
    from hil.analysis.difference import compare
    from hil.errors import EXIT_STABLE, EXIT_UNSTABLE

    found = compare(options.a, options.b)
    status = EXIT_STABLE if found.first is None else EXIT_UNSTABLE
    if options.json:
        differences = [{"time_s": d.time_ns * 1e-9, **asdict(d)} for d in found.differences]
        until = found.until_ns * 1e-9
        print(json.dumps({"same": not differences, "until_s": until, "start": found.start, "differences": differences}))
        return status
    for key, (a, b) in found.start.items():
        print(f"{key}: {a or 'nothing'} in A, {b or 'nothing'} in B")
    if found.first is None:
        print(f"the same up to {found.until_ns * 1e-9:.3f} s, as far as both go")
        return status
    print(f"the first difference\n  {found.first}")
    rest = found.differences[1:]
    if rest:
        print("then, by node")
        print("".join(f"  {difference}\n" for difference in rest[:_SHOWN]), end="")
    if len(rest) > _SHOWN:
        print(f"  and {len(rest) - _SHOWN} more (--json lists all)")
    return status
