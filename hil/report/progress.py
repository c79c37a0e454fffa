"""Live progress of a run on a terminal: simulated time, real-time factor, CoM error, bus load."""

from __future__ import annotations

import math
import time
from typing import IO, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hil.scenario import Scenario

_PERIOD_S = 0.2


class Display:
    """A line that renews itself; nothing at all when the stream is not a terminal."""

    def __init__(self, scenario: Scenario, stream: IO[str]) -> None:
        console = Console(file=stream)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:5.1f}/{task.total:.0f} s  {task.fields[text]}"),
            console=console,
            auto_refresh=False,  # no thread beside the calendar
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._progress.add_task(scenario.name, total=scenario.duration, text="starting")
        self._next = 0.0

    def __enter__(self) -> Display:
        self._progress.start()
        self._progress.refresh()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, system: Any, elapsed: float) -> None:
        """Show where the run is; cheap when called too early."""
        now = time.monotonic()
        if now < self._next or self._progress.disable:
            return
        self._next = now + _PERIOD_S
        simulated = system.now_ns * 1e-9
        error = system.observer.com_error()
        load = " ".join(f"{100 * share:.0f} %" for share in system.observer.bus_loads())
        speed = simulated / elapsed if elapsed > 0 else math.nan
        com = f"{1e3 * error:5.1f} mm" if math.isfinite(error) else "–"  # nothing is wanted of it yet
        text = f"{speed:4.2f}× real time  CoM {com}  bus {load}"
        self._progress.update(self._task, completed=simulated, text=text)
        self._progress.refresh()


class Counter:
    """Progress of many runs: how many are done, for how long they have run, and how long they will.

    On a stream that is no terminal nothing at all.
    """

    def __init__(self, title: str, total: int, what: str, stream: IO[str]) -> None:
        console = Console(file=stream)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn(f"{what}, {{task.fields[text]}}"),
            TimeElapsedColumn(),
            TextColumn("gone,"),
            TimeRemainingColumn(),
            TextColumn("to go"),
            console=console,
            speed_estimate_period=600.0,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._progress.add_task(title, total=total, text="")

    def __enter__(self) -> Counter:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, done: int, text: str = "") -> None:
        """``done`` of them are; ``text`` is shown."""
        self._progress.update(self._task, completed=done, text=text)
