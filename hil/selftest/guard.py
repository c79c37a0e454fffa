"""The process between a launcher and what it starts: ``python guard.py DIRECTORY LIMIT COMMAND …``.

Ends COMMAND and all its descendants, and removes DIRECTORY, as soon as COMMAND ends, LIMIT seconds have passed, or
standard input ends, which it does when the launcher is gone, whatever killed it. Exit status: COMMAND's, or TIMEOUT.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import shutil
import signal
import subprocess
import sys
import time

TIMEOUT = 124  # as of timeout(1)
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_LOOK_S = 0.1


def _children() -> list[int]:
    with open(f"/proc/self/task/{os.getpid()}/children", encoding="ascii") as file:
        return [int(pid) for pid in file.read().split()]


def _end_all() -> None:
    """Kill until nothing is left: whoever loses its parent becomes a child of this process."""
    while children := _children():
        for pid in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(-1, 0)


def guard(directory: str, limit_s: float, command: list[str]) -> int:
    """Run ``command`` under the rules above."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the launcher decides, by ending
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    deadline = time.monotonic() + limit_s
    status: int | None = None
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, preexec_fn=lambda: libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        )
        while (status := process.poll()) is None and time.monotonic() < deadline:
            if select.select([0], [], [], _LOOK_S)[0] and not os.read(0, 1):
                break
    finally:
        _end_all()
        shutil.rmtree(directory, ignore_errors=True)
    return TIMEOUT if status is None else status


if __name__ == "__main__":
    sys.exit(guard(sys.argv[1], float(sys.argv[2]), sys.argv[3:]))
