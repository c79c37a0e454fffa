"""Types of command-line arguments that several subcommands take."""

from __future__ import annotations

import argparse


def natural(text: str) -> int:
    """0, 1, 2 … Raises argparse.ArgumentTypeError."""
    if not (text.isascii() and text.isdigit() and len(text) <= 20):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 0, 1, 2 …")
    return int(text)
