"""Errors that end a command, each with its exit status."""

from __future__ import annotations

EXIT_STABLE = 0
EXIT_UNSTABLE = 1
EXIT_USER = 2
EXIT_EMULATION = 3


class HilError(Exception):
    """Base of the errors that a command reports in one sentence."""

    exit_status = EXIT_EMULATION


class UserError(HilError):
    """The user asked for something that cannot be: a wrong key, a value out of range, an unknown name."""

    exit_status = EXIT_USER


class EmulationError(HilError):
    """The emulation itself failed: a process died or stopped answering."""


class Interrupted(HilError):
    """A signal asked the run to end."""

    def __init__(self, signal_name: str) -> None:
        super().__init__(f"ended by {signal_name}")
        self.signal_name = signal_name
