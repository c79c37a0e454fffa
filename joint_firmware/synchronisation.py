"""At power-on: where the joint is, from its absolute encoder (Kim 2018 §5.4.1).

The motor's quadrature encoder counts from zero wherever power comes on. With q the absolute encoder's angle less its
calibrated offset and d the deflection of the compliant element, the motor is at phi = f(q) + d; what its encoder reads
beyond that is its zero. The mean of several interrupts is finer than the absolute encoder, whose noise dithers it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from joint_firmware.config import Settings
from robots import pins

SAMPLES = 32  # about 10 ms at 3 kHz; noise of a count averages to a fifth of it


class Synchronisation:
    """``done`` after ``samples`` calls of ``add``, at most SAMPLES; ``motor_offset`` is then known."""

    def __init__(self, samples: int) -> None:
        self._wanted = max(min(samples, SAMPLES), 1)
        self._sum, self._taken = 0.0, 0

    @property
    def done(self) -> bool:
        return self._taken >= self._wanted

    @property
    def motor_offset(self) -> float:
        """What the motor's encoder reads with the joint at 0 and the compliant element relaxed, rad."""
        return self._sum / self._taken

    def add(self, inputs: Sequence[int], settings: Settings) -> None:
        """Take the sample on the pins ``inputs``."""
        joint = settings.joint
        theta = inputs[pins.MOTOR_ENCODER] / joint.sensor.encoder
        deflection = inputs[pins.SPRING_ENCODER] / joint.spring_counts_per_rad - settings.spring_offset
        q = inputs[pins.JOINT_ENCODER] / joint.sensor.joint_encoder - settings.joint_offset
        self._sum += theta - deflection - motor_coordinate(settings, q)
        self._taken += 1

    def snapshot(self) -> Any:
        return self._sum, self._taken

    def restore(self, state: Any) -> None:
        self._sum, self._taken = state


def motor_coordinate(settings: Settings, q: float) -> float:
    """phi = f(q) of the joint, rad, in equivalent rotary coordinates (Kim 2018 (5.22))."""
    linkage = settings.joint.actuator.linkage
    return q if linkage is None else float(linkage.motor_coordinate(q))


def recalibrated(settings: Settings, joint_offset: float, q: float) -> dict[str, float]:
    """The changes of ``settings`` that another offset of the absolute encoder makes with the joint sensed at ``q``."""
    corrected = q - (joint_offset - settings.joint_offset)
    shift = motor_coordinate(settings, corrected) - motor_coordinate(settings, q)
    return {"joint_offset": joint_offset, "motor_offset": settings.motor_offset - shift}
