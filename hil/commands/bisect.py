"""``hil bisect STABLE UNSTABLE``: the differences that are responsible."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from hil.commands.arguments import natural
from hil.errors import EXIT_STABLE


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("bisect", help="name what makes the one of two configurations unstable")
    parser.add_argument("stable", metavar="STABLE", help="a scenario, or the record of a run")
    parser.add_argument("unstable", metavar="UNSTABLE", nargs="?", help="another; left out: the same scenario")
    for name, meaning in (("set", "both"), ("stable-set", "the stable one"), ("unstable-set", "the unstable one")):
        text = f"change a value of {meaning}; repeatable"
        parser.add_argument(f"--{name}", action="append", default=[], metavar="KEY=VALUE", help=text)
    parser.add_argument("--seed", type=natural, metavar="N", help="of both (0, or that of the record)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_bisect)


def _bisect(options: argparse.Namespace) -> int:
    from hil.lab.bisect import bisect, side

    stable = side(options.stable, [*options.set, *options.stable_set], options.seed)
    unstable = side(options.unstable or options.stable, [*options.set, *options.unstable_set], options.seed)

    def told(number: int, count: int, result: str, reason: str) -> None:
        print(f"run {number}, {count} difference{'s' * (count != 1)}: {result}, {reason}", file=sys.stderr)

    found = bisect(stable, unstable, told)
    names = [change.name for change in found.changes]
    if options.json:
        print(json.dumps({"responsible": names, "reason": found.reason, "runs": found.runs, "of": found.candidates}))
        return EXIT_STABLE
    print(f"responsible, of {found.candidates} differences, after {found.runs} runs:")
    print("".join(f"  {name}\n" for name in names), end="")
    print(f"with {'it' if len(names) == 1 else 'these'} alone: {found.reason}")
    if len(names) > 1:
        print("without any one of them it is stable")
    return EXIT_STABLE
