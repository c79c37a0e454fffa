"""Three encoders that watch each other: of the motor, of the spring's deflection and of the joint, for two angles.

    residual = (theta − deflection) − q, constant whatever moves

The residual is compared with what it was when the drive started, so that an error of the calibration is none of an
encoder. It changes only when an encoder is wrong; which one, each fault tells in its own way. Within an interrupt: the
one whose own step is not like its step before. Slowly: the one whose counts stand still meanwhile. Else it stays open.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from bus.drive_faults import DriveFault
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Block, Offsets, Symbols
from joint_firmware.laws.load_cell import has_load_cell
from joint_firmware.laws.signals import Sensed
from robots import pins
from robots.description import Joint


class Encoder(NamedTuple):
    name: str
    pin: int
    scale: str  # parameter, rad per count
    fault: DriveFault


_ENCODERS = (
    Encoder("motor", pins.MOTOR_ENCODER, "rad_per_count", DriveFault.MOTOR_ENCODER),
    Encoder("spring", pins.SPRING_ENCODER, "rad_per_spring_count", DriveFault.SPRING_ENCODER),
    Encoder("joint", pins.JOINT_ENCODER, "rad_per_joint_count", DriveFault.JOINT_ENCODER),
)


def within(*values: ca.SX) -> ca.SX:
    """The largest."""
    largest = values[0]
    for value in values[1:]:
        largest = ca.fmax(largest, value)
    return largest


class EncoderWatch(Block):
    states = (
        *[f"{encoder.name}_{what}" for encoder in _ENCODERS for what in ("angle", "step", "anchor")],
        "residual", "residual_zero",
    )  # fmt: skip
    parameters = (
        *[encoder.scale for encoder in _ENCODERS], "encoder_jump", "encoder_stuck", "encoder_mismatch",
        "has_spring",
    )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        limits = config.protection
        return {
            "rad_per_count": 1.0 / joint.sensor.encoder,
            "rad_per_spring_count": 1.0 / joint.spring_counts_per_rad,
            "rad_per_joint_count": 1.0 / joint.sensor.joint_encoder,
            "encoder_jump": limits.encoder_jump,
            "encoder_stuck": limits.encoder_stuck,
            "encoder_mismatch": limits.encoder_mismatch,
            "has_spring": float(not has_load_cell(joint)),
        }

    def watch(
        self, counts: ca.SX, sensed: Sensed, x: Symbols, p: Symbols
    ) -> tuple[list[tuple[DriveFault, ca.SX, str | None]], Symbols]:
        """Levels of the faults with the parameters of their times, and the states of the next tick."""
        started = x.started > 0
        angles = [counts[encoder.pin] * getattr(p, encoder.scale) for encoder in _ENCODERS]
        residual = sensed.position - angles[-1]
        before = ca.if_else(started, x.residual, residual)
        zero = ca.if_else(started, x.residual_zero, residual)
        jump = ca.fabs(residual - before) / p.encoder_jump

        steps, surprises, still = [], [], []
        for encoder, angle in zip(_ENCODERS, angles, strict=True):
            was = getattr(x, f"{encoder.name}_angle")
            steps.append(ca.if_else(started, angle - was, 0))
            surprises.append(ca.fabs(steps[-1] - getattr(x, f"{encoder.name}_step")))
            still.append(ca.logic_and(started, angle == was))
        culprit = within(*surprises)

        watches: list[tuple[DriveFault, ca.SX, str | None]] = []
        following: dict[str, ca.SX] = {"residual": residual, "residual_zero": zero}
        for encoder, angle, step, surprise, stands in zip(_ENCODERS, angles, steps, surprises, still, strict=True):
            anchor = getattr(x, f"{encoder.name}_anchor")
            kept = ca.if_else(ca.logic_and(stands, jump <= 1.0), anchor, residual)
            watches.append((encoder.fault, jump * (surprise == culprit), None))
            there = p.has_spring if encoder.fault is DriveFault.SPRING_ENCODER else 1.0
            watches.append((encoder.fault, there * ca.fabs(residual - kept) / p.encoder_stuck, "encoder_time"))
            following |= {
                f"{encoder.name}_angle": angle, f"{encoder.name}_step": step, f"{encoder.name}_anchor": kept,
            }  # fmt: skip
        watches.append((DriveFault.ENCODER_MISMATCH, ca.fabs(residual - zero) / p.encoder_mismatch, "encoder_time"))
        return watches, Symbols(**following)
