"""The delay margin of a drive as it is found: by delaying its outputs until an oscillation no longer dies away."""

from __future__ import annotations

import math

import numpy as np

from hil.joint_lab.rig import TRUTH, Rig
from hil.joint_lab.setup import Setup
from hil.record.signals import Signals

_BOOT_S = 0.1  # the drive is enabled by then
_KICK_PERIODS = 0.5  # of the oscillation at the margin
_PERIODS = 12  # per window
_REST, _FAR = 0.05, 2.0  # of the kick


def grows(setup: Setup, kick: float, omega: float) -> bool:
    """Whether an oscillation near ``omega`` rad/s that a kick of ``kick`` N m has started grows.

    It does when its mean square is greater in a later window than in an earlier one, or when it has ended in a fault.
    What has fallen to a twentieth of the kick has died away: the rest is the sensors' resolution at work. What is far
    beyond the kick has grown, also when the drive's limits hold it there by now.
    """
    period = 2.0 * math.pi / omega
    ticks = max(round(_KICK_PERIODS * period * setup.timing.servo_rate), 1)
    window = _PERIODS * period
    start = _BOOT_S + (_KICK_PERIODS + 2.0) * period
    rig = Rig(setup, setup.torque_command(lambda tick, _: kick if tick < ticks else 0.0))
    rig.run(start + 2.0 * window)
    if rig.master.failure is not None:
        return True
    truth = rig.recorder.table(TRUTH)
    later = _power(truth, start + window, window)
    return later > (_FAR * kick) ** 2 or later > max(_power(truth, start, window), (_REST * kick) ** 2)


def _power(truth: Signals, start: float, length: float) -> float:
    chosen = (truth.seconds >= start) & (truth.seconds < start + length)
    return float(np.var(truth["spring_torque"][chosen]))


def delay_margin(setup: Setup, kick: float, omega: float, predicted: float, resolution: float) -> float:
    """Delay between drive and actuator, s, at which an oscillation grows: the middle of a bracket of ``resolution``.

    Args:
        kick: torque that starts it, N m.
        omega: where it is expected, rad/s.
        predicted: delay where the search begins, s.

    Raises ValueError when the drive oscillates without any delay, or not even with eight times the predicted one.
    """
    if grows(setup.delayed(0.0), kick, omega):
        raise ValueError("the loop is unstable without any extra delay")
    low, high = 0.0, max(predicted, resolution)
    while not grows(setup.delayed(high), kick, omega):
        low, high = high, 2.0 * high
        if high > 8.0 * max(predicted, resolution):
            raise ValueError(f"no growing oscillation up to a delay of {1e3 * low:.3g} ms")
    while high - low > resolution:
        middle = 0.5 * (low + high)
        if grows(setup.delayed(middle), kick, omega):
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)
