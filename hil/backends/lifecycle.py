"""Children of a run: they die with the launcher, whatever kills it, and the launcher learns at once of their death."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from hil.errors import EmulationError, Interrupted

_PR_SET_PDEATHSIG = 1
REPLY = 1 << 20
_ATTENTION = 1 << 40  # written by signal handlers: look at what happened
STUCK_AFTER_S = 10.0

_fork = multiprocessing.get_context("fork")


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its parent dies, also by SIGKILL."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the call
        os._exit(3)


def quiet_collector() -> None:
    """Keep the cycle collector out of the real-time loop: what exists by now will stay."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)


def _status(process: Any) -> int | None:
    """Exit status of a child, None while it lives."""
    return process.poll() if isinstance(process, subprocess.Popen) else process.exitcode


class Family:
    """The processes of a run and one eventfd on which the launcher waits for all of them.

    The eventfd adds up: 1 per finished joint, REPLY per answer of the controller, _ATTENTION from a signal handler.
    Signal handlers only write to it, so a signal can neither be lost between a check and a wait nor break a step.
    """

    def __init__(self) -> None:
        self.done = os.eventfd(0)
        self._processes: dict[str, Any] = {}
        self._joints_done = 0
        self._replies = 0
        self._progress = 0  # waits that ended
        self._seen = (-1, 0.0)  # progress at the last look, and when it was new
        self._signal: str | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Family:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            self._previous[number] = signal.signal(number, self._on_end)
        for number in (signal.SIGCHLD, signal.SIGALRM):
            self._previous[number] = signal.signal(number, self._on_attention)
        signal.setitimer(signal.ITIMER_REAL, 1.0, 1.0)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        self.end()
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        os.close(self.done)

    def _on_end(self, number: int, _: object) -> None:
        self._signal = signal.Signals(number).name
        os.eventfd_write(self.done, _ATTENTION)

    def _on_attention(self, number: int, _: object) -> None:
        os.eventfd_write(self.done, _ATTENTION)

    def spawn(self, name: str, target: Callable[..., None], *args: Any) -> None:
        """Fork a child that runs ``target(*args)``; it ends when that returns or the launcher is gone."""
        parent = os.getpid()

        def body() -> None:
            die_with_parent(parent)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's to handle
            for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD, signal.SIGALRM):
                signal.signal(number, signal.SIG_DFL)
            try:
                target(*args)
            except BaseException:
                sys.stderr.write(f"{name}:\n{traceback.format_exc()}")
                sys.stderr.flush()
                os._exit(3)
            os._exit(0)

        process = _fork.Process(target=body, name=f"hil-{name}", daemon=True)
        process.start()
        self._processes[name] = process

    def execute(self, name: str, module: str, pipe: Connection) -> None:
        """Start ``python -m module FD PARENT`` in a process group of its own (Ctrl-C does not reach it)."""
        descriptor = pipe.fileno()
        command = [sys.executable, "-m", module, str(descriptor), str(os.getpid())]
        self._processes[name] = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, pass_fds=[descriptor], process_group=0
        )
        pipe.close()

    @property
    def pids(self) -> dict[str, int]:
        """Process id of every child by name."""
        return {name: process.pid for name, process in self._processes.items()}

    def check(self) -> None:
        """Raise Interrupted after a signal, EmulationError when a child has died."""
        if self._signal is not None:
            raise Interrupted(self._signal)
        for name, process in self._processes.items():
            code = _status(process)
            if code is not None:
                how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
                raise EmulationError(f"the process of {name} (pid {process.pid}) {how}")

    def wait_joints(self, count: int) -> None:
        """Wait until ``count`` joints have finished their tick."""
        while self._joints_done < count:
            self._read("the joints")
        self._joints_done -= count
        self._progress += 1

    def wait_reply(self) -> None:
        """Wait for one answer of the controller."""
        while not self._replies:
            self._read("the controller")
        self._replies -= 1
        self._progress += 1

    def _read(self, whom: str) -> None:
        try:
            total = os.eventfd_read(self.done)
        except InterruptedError:
            return  # the handler has written to it: the caller reads again
        if total >= _ATTENTION:
            self.check()
            self._check_stuck(whom)
        self._joints_done += total & (REPLY - 1)
        self._replies += (total & (_ATTENTION - 1)) >> 20

    def _check_stuck(self, whom: str) -> None:
        """Called about once a second while waiting."""
        progress, since = self._seen
        if progress != self._progress:
            self._seen = (self._progress, time.monotonic())
        elif time.monotonic() - since > STUCK_AFTER_S:
            raise EmulationError(f"{whom} did not answer for {STUCK_AFTER_S:.0f} s")

    def end(self) -> None:
        """End all children now: ask, then kill."""
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait() if isinstance(process, subprocess.Popen) else process.join()
        self._processes.clear()
