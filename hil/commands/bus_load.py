"""``hil bus load``: does a scenario's traffic fit onto its buses? The table of response times, without a run."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, UserError

if TYPE_CHECKING:  # the command line starts without it
    from hil.analysis.message_set import Traffic


def background(text: str) -> Traffic:
    """Additional traffic as ``IDENTIFIER:BYTES:PERIOD`` says, e.g. ``0x050:8:1ms``, or with ``:classic`` behind it.
    Raises UserError."""
    from bus.frames import CAN_FD_LENGTHS, EXTENDED_ID_LIMIT
    from hil.analysis.message_set import Traffic

    where = f"--with {text}"
    parts = text.split(":")
    fd = parts[3:] != ["classic"]
    if len(parts) != 3 and fd:
        raise UserError(
            f"{where}: expected IDENTIFIER:BYTES:PERIOD or IDENTIFIER:BYTES:PERIOD:classic, e.g. 0x050:8:1ms"
        )
    try:
        identifier = int(parts[0], 0)
    except ValueError:
        identifier = -1
    if not 0 <= identifier < EXTENDED_ID_LIMIT:
        raise UserError(f"{where}: expected an identifier from 0 to {EXTENDED_ID_LIMIT - 1:#x}, for example 0x050")
    length = int(parts[1]) if parts[1].isascii() and parts[1].isdigit() and len(parts[1]) < 4 else -1
    lengths = CAN_FD_LENGTHS if fd else CAN_FD_LENGTHS[:9]
    if length not in lengths:
        raise UserError(f"{where}: expected a number of bytes of {', '.join(map(str, lengths))}")
    period = duration(parts[2], where)
    return Traffic(f"background {identifier:#05x}", identifier, length, period, offset=None, fd=fd)


def duration(text: str, where: str) -> int:
    """A time from 1 µs to an hour in ns. Raises UserError."""
    from robots.quantities import parse_quantity

    try:
        seconds = parse_quantity(text, "s")
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None
    if not 1e-6 <= seconds <= 3600:
        raise UserError(f"{where}: expected a time from 1us to 3600s")
    return round(seconds * 1e9)


_COLUMNS = ("period", "jitter", "frame", "blocking", "planned", "response", "deadline", "slack")


def _print(table: dict[str, Any]) -> None:
    def us(value: float | None, missing: str = "–") -> str:
        return missing if value is None else f"{1e6 * value:.1f}"

    interval = table["fault_interval"]
    faults = "no faults" if interval is None else f"at most one fault per {1e3 * interval:g} ms"
    print(f"{table['scenario']}: times in µs, frames as long as any content makes them, {faults}")
    for name, bus in table["buses"].items():
        rates = f"{bus['arbitration_rate'] / 1e6:g}/{bus['data_rate'] / 1e6:g} Mbit/s"
        answer = "schedulable" if bus["schedulable"] else "NOT schedulable"
        print(f"\n{name}, {rates}: {answer}, utilisation {100 * bus['utilisation']:.1f} %")
        width = max(len(row["name"]) for row in bus["messages"])
        print(f"  {'id':>8} {'':{width}} {'bytes':>5}" + "".join(f"{column:>10}" for column in _COLUMNS))
        for row in bus["messages"]:
            cells = "".join(f"{us(row[c], '∞' if c == 'response' else '–'):>10}" for c in _COLUMNS)
            late = "" if row["schedulable"] else "  late"
            print(f"  {row['identifier']:#8x} {row['name']:{width}} {row['length']:>5}{cells}{late}")
    print("\nresponse: bound for any offsets; planned: at the scenario's offsets, without jitter and emergencies")


def add_parser(commands: Any) -> None:
    parser = commands.add_parser("load", help="the table of response times of a scenario's buses, without a run")
    parser.add_argument("scenario", metavar="SCENARIO", help="a built-in scenario or the path of a .toml file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="change one value of the scenario; repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--with", action="append", default=[], metavar="ID:BYTES:PERIOD[:classic]", dest="extra",
        help="additional traffic on every bus, CAN FD or classical, e.g. 0x050:8:1ms; repeatable",
    )  # fmt: skip
    parser.add_argument("--faults", metavar="TIME", help="at most one damaged frame in any such time, e.g. 10ms")
    parser.add_argument("--json", action="store_true", help="print one JSON object, times in s")
    parser.set_defaults(command=_run)


def _run(options: argparse.Namespace) -> int:
    from hil.analysis.message_set import load_table, traffic
    from hil.scenario import load
    from robots import description

    scenario = load(options.scenario, options.settings)
    robot = description.load(scenario.robot)
    extra = [background(text) for text in options.extra]
    taken: dict[int, str] = {
        t.identifier: f"the {t.name}" for bus in robot.buses for t in traffic(scenario, robot, bus)
    }
    for text, t in zip(options.extra, extra, strict=True):
        if t.identifier in taken:
            raise UserError(f"--with {text}: {taken[t.identifier]} has this identifier already")
        taken[t.identifier] = "another --with"
    interval = None if options.faults is None else duration(options.faults, f"--faults {options.faults}")
    table = load_table(scenario, extra, interval)
    if options.json:
        print(json.dumps(table, allow_nan=False))
    else:
        _print(table)
    return EXIT_STABLE if table["schedulable"] else EXIT_UNSTABLE
