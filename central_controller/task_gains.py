"""Gains of a task."""

from __future__ import annotations

from robots.quantities import Config, Gain


class TaskGains(Config):
    """PID of one task coordinate, in accelerations: kp [1/s²], kd [1/s], ki [1/s³]."""

    kp: Gain
    kd: Gain
    ki: Gain = 0.0
