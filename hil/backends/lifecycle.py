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
STUCK_AFTER_S = 10.0
_LOOK_S = 0.05  # how often a waiting launcher looks after its children
_NAP_S = 20e-6
# Polls before the first nap, some hundred microseconds; none where the awaited needs the only core.
_SPINS = 2000 if len(os.sched_getaffinity(0)) > 1 else 0

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
    """The processes of a run: started together, watched, and ended together.

    Args:
        signals: whether SIGINT, SIGTERM and SIGHUP end the run in order; else they are the caller's.
    """

    def __init__(self, signals: bool = True) -> None:
        self._signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if signals else ()
        self._processes: dict[str, Any] = {}
        self._signal: str | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Family:
        for number in self._signals:
            self._previous[number] = signal.signal(number, self._on_end)
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _on_end(self, number: int, _: object) -> None:
        self._signal = signal.Signals(number).name

    def spawn(self, name: str, target: Callable[..., None], *args: Any) -> None:
        """Fork a child that runs ``target(*args)``; it ends when that returns or the launcher is gone."""
        parent = os.getpid()

        def body() -> None:
            die_with_parent(parent)
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's to handle
            for number in (signal.SIGTERM, signal.SIGHUP):
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

    def wait(self, ready: Callable[[], Any], whom: str) -> Any:
        """The first value of ``ready()`` that is not None. Raises as ``check`` does, and EmulationError when
        nothing comes for STUCK_AFTER_S.

        Polls: a process that sleeps takes longer to wake than most answers take to come.
        """
        for _ in range(_SPINS):
            value = ready()
            if value is not None:
                return value
        began = looked = time.monotonic()
        while (value := ready()) is None:
            time.sleep(_NAP_S)
            now = time.monotonic()
            if now - looked > _LOOK_S:
                looked = now
                self.check()
                if now - began > STUCK_AFTER_S:
                    raise EmulationError(f"{whom} did not answer for {STUCK_AFTER_S:.0f} s")
        return value

    def end(self) -> None:
        """End all children now: ask, then kill."""
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait() if isinstance(process, subprocess.Popen) else process.join()
        self._processes.clear()
