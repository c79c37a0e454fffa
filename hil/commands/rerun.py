"""``hil rerun DIR``: a recorded run for the Rerun viewer: signals, the robot as it moved, the forces at its feet."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hil.errors import EXIT_STABLE, UserError


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("rerun", help="write a recorded run for the Rerun viewer (.rrd)")
    parser.add_argument("directory", type=Path, metavar="DIR", help="the run's record")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the file (default: DIR/run.rrd)")
    parser.set_defaults(command=_rerun)


def _rerun(options: argparse.Namespace) -> int:
    from hil.lab.extras import require
    from hil.record.recorded import read_run

    require("rerun", extra="rerun")
    from hil.report.rerun_file import write_rerun

    found = read_run(options.directory)
    out = options.out or options.directory / "run.rrd"
    if out.is_dir() or not out.parent.is_dir():
        what = "is a directory" if out.is_dir() else "its directory does not exist"
        raise UserError(f"--out {out}: expected a file to write ({what})")
    write_rerun(out, found)
    print(f"{found.end:.2f} s of {found.scenario.name}, seed {found.seed}")
    print(f"rerun       {out}  (open it with: rerun {out})")
    return EXIT_STABLE
