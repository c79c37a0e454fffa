"""Types of command-line arguments that several subcommands take."""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import UserError

if TYPE_CHECKING:
    from hil.scenario import Scenario


def natural(text: str) -> int:
    """0, 1, 2 … Raises argparse.ArgumentTypeError."""
    if not (text.isascii() and text.isdigit() and len(text) <= 20):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 0, 1, 2 …")
    return int(text)


def record_directory(out: Path | None, default: str = "") -> Path:
    """The directory ``--out`` of a record, created; None: ``default`` under runs/. Its name is the run's: it
    becomes part of Zenoh keys. Raises UserError."""
    if out is None:
        for n in range(1, 100):  # two runs within one second
            candidate = Path("runs") / (default if n == 1 else f"{default}-{n}")
            if not candidate.exists():
                out = candidate
                break
    assert out is not None
    if out.name in ("", ".."):
        out = out.resolve()
    name = out.name
    if not name or set(name) & set("*$?#"):
        raise UserError(f"--out {out}: the last part names the run and must not contain * $ ? #")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UserError(f"--out {out}: is a file; name a directory") from None
    except OSError as error:
        raise UserError(f"--out {out}: cannot be created ({error.strerror})") from None
    if any((out / record).exists() for record in ("run.json", "signals.mcap")):
        raise UserError(f"--out {out}: holds the record of another run; name a new directory")
    if not os.access(out, os.W_OK | os.X_OK):
        raise UserError(f"--out {out}: cannot be written to")
    return out


def positive(text: str) -> int:
    """1, 2, 3 … Raises argparse.ArgumentTypeError."""
    if natural(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 1, 2, 3 …")
    return int(text)


def with_second(text: str) -> str:
    """``text`` with the unit s when it is a bare number."""
    try:
        return f"{text.strip()}s" if math.isfinite(float(text)) else text
    except ValueError:
        return text


def seconds(option: str, text: str) -> float:
    """The time that ``option`` was given, s. Raises UserError."""
    from robots.quantities import parse_quantity

    try:
        value = parse_quantity(with_second(text), "s")
    except ValueError as error:
        raise UserError(f"{option}: {error}") from None
    if value < 0:
        raise UserError(f"{option} {text}: expected 0s or more")
    return value


def add_scenario(parser: Any) -> None:
    """The arguments from which ``scenario_of`` loads."""
    parser.add_argument("scenario", metavar="SCENARIO", help="a built-in scenario or the path of a .toml file")
    parser.add_argument("--duration", metavar="S", help="simulated time of each run, e.g. 10s")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="change one value of the scenario; repeatable",
    )  # fmt: skip


def scenario_of(options: argparse.Namespace) -> Scenario:
    """The scenario that was asked for. Raises UserError."""
    from hil.scenario import load

    settings = list(options.settings)
    if options.duration is not None:
        settings.append(f"duration={with_second(options.duration)}")
    return load(options.scenario, settings)
