"""``hil bus``: a group of subcommands around the emulated bus."""

from __future__ import annotations

from typing import Any

from hil.commands import bus_alone, bus_load, bus_sweep


def add_parser(commands: Any) -> None:
    bus = commands.add_parser("bus", help="the emulated bus by itself")
    subcommands = bus.add_subparsers(required=True, metavar="COMMAND")
    bus_alone.add_parser(subcommands)
    bus_load.add_parser(subcommands)
    bus_sweep.add_parser(subcommands)
