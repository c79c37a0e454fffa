"""From counts to SI: motor and joint position, their velocities, torque.

The spring sits between motor and joint: torque is its stiffness times its deflection, the joint is where the motor is
less the deflection. Velocities are differenced encoders behind a first-order filter.
"""

from __future__ import annotations

import math

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Block, Offsets, Symbols
from joint_firmware.laws.signals import Sensed
from robots import pins
from robots.description import Joint


class Sensing(Block):
    states = ("theta", "position", "motor_velocity", "velocity", "started")
    parameters = (
        "rad_per_count", "rad_per_spring_count", "stiffness", "dt", "velocity_blend", "motor_offset", "spring_offset",
    )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        dt = 1.0 / config.rate
        return {
            "rad_per_count": 1.0 / joint.sensor.encoder,
            "rad_per_spring_count": 1.0 / joint.spring_counts_per_rad,
            "stiffness": joint.actuator.stiffness,
            "dt": dt,
            "velocity_blend": 1.0 - math.exp(-2.0 * math.pi * config.velocity_cutoff * dt),
            "motor_offset": offsets.motor,
            "spring_offset": offsets.spring,
        }

    def sense(self, counts: ca.SX, x: Symbols, p: Symbols) -> tuple[Sensed, Symbols]:
        """The signals, and the states of the next tick."""
        theta = counts[pins.MOTOR_ENCODER] * p.rad_per_count - p.motor_offset
        deflection = counts[pins.SPRING_ENCODER] * p.rad_per_spring_count - p.spring_offset
        position, torque = theta - deflection, p.stiffness * deflection
        blend = x.started * p.velocity_blend
        motor_velocity = x.motor_velocity + blend * ((theta - x.theta) / p.dt - x.motor_velocity)
        velocity = x.velocity + blend * ((position - x.position) / p.dt - x.velocity)
        x_next = Symbols(theta=theta, position=position, motor_velocity=motor_velocity, velocity=velocity, started=1)
        return Sensed(theta, position, motor_velocity, velocity, torque), x_next
