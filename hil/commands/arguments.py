"""Types of command-line arguments that several subcommands take."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from hil.errors import UserError


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
