"""``hil socketcan-selftest``: the nodes on real SocketCAN, with candump and canopen as witnesses.

The tests run on the kernel here when that has CAN and permits virtual interfaces, else inside user-mode Linux.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

from hil.errors import EXIT_EMULATION, EmulationError, UserError
from hil.selftest.checks import TESTS, NotRun

_LIMIT_S = 300.0
_LINE = re.compile(r"(ok|FAILED|not run) +([^:]+): (.*)")


class Result(NamedTuple):
    """Outcome of one test: ``ok``, ``FAILED`` or ``not run``, and what was seen."""

    outcome: str
    name: str
    detail: str

    def __str__(self) -> str:
        return f"{self.outcome:8}{self.name}: {self.detail}"


def test_here() -> Iterator[Result]:
    """Run all tests on this kernel."""
    for name, test in TESTS.items():
        try:
            yield Result("ok", name, test())
        except NotRun as reason:
            yield Result("not run", name, str(reason))
        except Exception as error:
            yield Result("FAILED", name, f"{type(error).__name__}: {error}".replace("\n", " "))


def test_in_guest(log: IO[str], limit_s: float) -> Iterator[Result]:
    """Run all tests inside user-mode Linux; its console goes to ``log``. Raises EmulationError when it fails itself."""
    from hil.selftest.uml import Guest

    with Guest([sys.executable, "-m", "hil", "socketcan-selftest", "--here"], limit_s) as guest:
        for line in guest:
            log.write(line + "\n")
            log.flush()
            match = _LINE.fullmatch(line)
            if match:
                yield Result(*match.groups())
        if guest.status not in (0, EXIT_EMULATION):
            raise EmulationError(f"the tests inside user-mode Linux ended with status {guest.status}")


def why_not_here() -> str | None:
    """Why the kernel here does not do, None when it does."""
    from bus.socketcan import Interfaces, SocketCanError

    try:
        Interfaces(["hiltest0"]).close()
    except SocketCanError as error:
        return str(error).partition(":")[0]
    return None


def add_parser(commands: Any) -> None:
    """The command ``hil socketcan-selftest``."""
    parser = commands.add_parser("socketcan-selftest", help="test on real SocketCAN, in user-mode Linux where needed")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--here", action="store_true", help="on the kernel here, or not at all")
    where.add_argument("--guest", action="store_true", help="in user-mode Linux, also when the kernel here would do")
    parser.add_argument("--limit", type=_seconds, default=_LIMIT_S, metavar="S", help=f"time limit ({_LIMIT_S:.0f} s)")
    parser.add_argument("--log", type=Path, metavar="FILE", help="where the guest's console goes (standard error)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_command)


def _seconds(text: str) -> float:
    try:
        value = float(text.removesuffix("s"))
    except ValueError:
        value = 0.0
    if not 1 <= value <= 3600:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 1 to 3600 seconds")
    return value


def _command(options: argparse.Namespace) -> int:
    reason = None if options.guest else why_not_here()
    here = not options.guest and reason is None
    if options.here and not here:
        raise UserError(f"{reason}; without --here the test boots user-mode Linux")
    results: list[Result] = []
    with contextlib.ExitStack() as stack:
        log: IO[str] = sys.stderr
        if options.log is not None and not here:
            try:
                log = stack.enter_context(options.log.open("w", encoding="utf-8"))
            except OSError as error:
                raise UserError(f"--log {options.log}: {error.strerror}") from None
        if not options.json:
            where = "on the kernel here" if here else "in user-mode Linux"
            print(where if reason is None else f"{where}, as {reason}", flush=True)
        for result in test_here() if here else test_in_guest(log, options.limit):
            results.append(result)
            if not options.json:
                print(result, flush=True)
    return _conclude(results, here, options.json)


def _conclude(results: Sequence[Result], here: bool, as_json: bool) -> int:
    good = [r for r in results if r.outcome != "FAILED"]
    complete = len(results) == len(TESTS)
    if as_json:
        print(json.dumps({"where": "here" if here else "user-mode Linux", "tests": [r._asdict() for r in results]}))
    if not complete:
        raise EmulationError(f"only {len(results)} of {len(TESTS)} tests came to an end")
    return 0 if len(good) == len(results) else EXIT_EMULATION
