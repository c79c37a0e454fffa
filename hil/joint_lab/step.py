"""Step response of a drive's torque through the emulation, from the log of its bus."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from hil.errors import EmulationError
from hil.joint_lab import log
from hil.joint_lab.rig import Rig
from hil.joint_lab.setup import Setup

_BOOT_S = 0.1
_BEFORE_S = 0.02  # from the drive's enabling to the step
_SETTLED = 0.2  # the last share of a response: what it has come to


class StepResponse(NamedTuple):
    """Torque over time. The step to ``target`` acts from time 0 on."""

    seconds: np.ndarray  # (n,) of the reports
    torque: np.ndarray  # (n,) N m, sensed
    target: float  # N m

    @property
    def _settled(self) -> np.ndarray:
        return self.torque[self.seconds >= (1.0 - _SETTLED) * self.seconds[-1]]

    @property
    def steady_error(self) -> float:
        """Target less the mean of the last fifth, N m."""
        return self.target - float(self._settled.mean())

    @property
    def ripple(self) -> float:
        """Half of what the torque still swings by in the last fifth, N m."""
        return 0.5 * float(np.ptp(self._settled))

    @property
    def rise_time(self) -> float | None:
        """From 10 % to 90 % of the target, s; None when it is not reached."""
        share = self.torque / self.target
        times = [self._first(share, level) for level in (0.1, 0.9)]
        return None if None in times else times[1] - times[0]  # type: ignore[operator]

    def _first(self, share: np.ndarray, level: float) -> float | None:
        above = np.flatnonzero(share >= level)
        if not len(above) or above[0] == 0:
            return None
        i = above[0]
        return float(np.interp(level, share[i - 1 : i + 1], self.seconds[i - 1 : i + 1]))

    @property
    def overshoot(self) -> float:
        """Beyond the target, as a share of it; 0 when it stays below."""
        return max(float((self.torque / self.target).max()) - 1.0, 0.0)


def run(setup: Setup, target: float, duration: float, directory: Path | None = None) -> StepResponse:
    """Step the torque command from 0 to ``target`` N m and watch for ``duration`` s, with a bus log in ``directory``.

    Raises EmulationError when the drive does not bear it.
    """
    if directory is None:
        with TemporaryDirectory() as scratch:
            return run(setup, target, duration, Path(scratch))
    wait = round(_BEFORE_S * setup.timing.servo_rate)
    rig = Rig(setup, setup.torque_command(lambda tick, _: target if tick >= wait else 0.0), directory)
    rig.run(_BOOT_S + _BEFORE_S + duration)
    rig.recorder.close()
    if rig.master.failure is not None:
        raise EmulationError(f"the step ended early: {rig.master.failure}")
    rate = int(setup.firmware.rate)
    path = directory / f"{setup.bus}.log"
    exchange = log.read(path, setup.joint.node_id, setup.slot, rate, setup.ticks_per_report)
    start = exchange.command_ticks[np.flatnonzero(exchange.commanded)[0]]
    seconds = (exchange.report_ticks - start) / rate
    shown = (seconds >= -_BEFORE_S / 2) & (seconds <= duration)
    return StepResponse(seconds[shown], exchange.torques[shown], target)
