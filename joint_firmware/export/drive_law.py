"""What is exported of a drive: its law's function, and name, unit and meaning of every number that goes in or out.

The only module of the export that knows how the firmware builds its law.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from joint_firmware import law
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.operations import Program, program
from robots import pins
from robots.description import Joint

LAWS = ("PD_m",)


class Quantity(NamedTuple):
    """One number of a vector: its name, an identifier of C; its unit, "" for a plain number."""

    name: str
    unit: str
    meaning: str


class DriveLaw(NamedTuple):
    """The law of one drive.

    ``function(counts, x, u, p) -> (x_next, y)``; ``counts`` … ``outputs`` describe these vectors item by item,
    ``values`` is p of this joint, ``gains`` says what of u a gain set fills in.
    """

    name: str
    function: ca.Function
    program: Program
    counts: tuple[Quantity, ...]
    state: tuple[Quantity, ...]
    input: tuple[Quantity, ...]
    parameters: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    values: np.ndarray
    gains: dict[str, dict[str, float]]


_COUNTS = ("motor_encoder", "spring_encoder", "current_adc")
_STATE = (
    "theta", "position", "motor_velocity", "velocity", "integral", "torque_reference", "kp", "active", "started",
)  # fmt: skip
_INPUT = (
    "torque", "position", "velocity", "limit", "torque_mode", "position_mode", "damping_mode", "kp", "ki", "kd",
)  # fmt: skip
_PARAMETERS = (
    "rad_per_count", "rad_per_spring_count", "stiffness", "torque_per_ampere", "current_limit", "dt", "velocity_blend",
    "torque_limit", "torque_step", "position_low", "position_high", "soft_stop_stiffness", "quick_stop_damping",
    "position_stiffness", "position_damping", "motor_offset", "spring_offset",
)  # fmt: skip
_OUTPUTS = (
    "position", "velocity", "torque", "current", "motor_velocity", "demand", "limited", "torque_si", "position_si",
)  # fmt: skip

# (unit, meaning) by vector and name
_GLOSSARY: dict[str, dict[str, tuple[str, str]]] = {
    "counts": {
        "motor_encoder": ("counts", "of the motor's encoder"),
        "spring_encoder": ("counts", "of the spring's deflection"),
        "current_adc": (f"{pins.AMPERE_PER_COUNT:g} A", "measured motor current"),
    },
    "x": {
        "theta": ("rad", "motor position at the last step, as seen from the joint"),
        "position": ("rad", "joint position at the last step"),
        "motor_velocity": ("rad/s", "filtered, as seen from the joint"),
        "velocity": ("rad/s", "of the joint, filtered"),
        "integral": ("N m", "what the torque loop has integrated"),
        "torque_reference": ("N m", "what the torque loop followed at the last step"),
        "kp": ("N m/(N m)", "gain at the last step"),
        "active": ("", "1: the torque loop was closed at the last step"),
        "started": ("", "0 at the first step: velocities start at zero"),
    },
    "u": {
        "torque": ("N m", "commanded torque; feed-forward in position mode"),
        "position": ("rad", "commanded position, of the motor"),
        "velocity": ("rad/s", "commanded velocity, of the motor"),
        "limit": ("N m", "of the torque's size, beside parameter torque_limit"),
        "torque_mode": ("", "1: follow the commanded torque, else 0"),
        "position_mode": ("", "1: follow the commanded position, else 0"),
        "damping_mode": ("", "1: only damp the motor's velocity, else 0; all three 0: no current"),
        "kp": ("N m/(N m)", "motor torque per torque error"),
        "ki": ("N m/(N m s)", "motor torque per integral of the torque error"),
        "kd": ("N m s/rad", "motor torque per motor velocity"),
    },
    "p": {
        "rad_per_count": ("rad", "per count of the motor's encoder, signed"),
        "rad_per_spring_count": ("rad", "of deflection per count of the spring's encoder, signed"),
        "stiffness": ("N m/rad", "of the spring"),
        "torque_per_ampere": ("N m/A", "motor torque at the joint"),
        "current_limit": ("A", "of the demand"),
        "dt": ("s", "period of the steps: call them at this rate"),
        "velocity_blend": ("", "share of the new sample in the velocities' first-order filter"),
        "torque_limit": ("N m", "of the torque that the loop follows"),
        "torque_step": ("N m", "most that the followed torque changes in a step"),
        "position_low": ("rad", "joint limit, where the soft stop begins"),
        "position_high": ("rad", "joint limit, where the soft stop begins"),
        "soft_stop_stiffness": ("N m/rad", "beyond a joint limit"),
        "quick_stop_damping": ("N m s/rad", "in damping mode"),
        "position_stiffness": ("N m/rad", "in position mode"),
        "position_damping": ("N m s/rad", "in position mode"),
        "motor_offset": ("rad", "zero of the motor's encoder"),
        "spring_offset": ("rad", "zero of the spring's encoder"),
    },
    "y": {
        "position": ("1e-6 rad", "of the joint, whole number"),
        "velocity": ("1e-5 rad/s", "of the joint, whole number"),
        "torque": ("1e-4 N m", "in the spring, whole number"),
        "current": ("1e-2 A", "measured, whole number"),
        "motor_velocity": ("1e-3 rad/s", "as seen from the joint, whole number"),
        "demand": (f"{pins.AMPERE_PER_COUNT:g} A", "current demand for the power stage, whole number"),
        "limited": ("", "1: a limit holds the command or the current back"),
        "torque_si": ("N m", "in the spring"),
        "position_si": ("rad", "of the joint"),
    },
}


def _quantities(vector: str, names: tuple[str, ...]) -> tuple[Quantity, ...]:
    return tuple(Quantity(name, *_GLOSSARY[vector][name]) for name in names)


def drive_law(name: str, joint: Joint, config: FirmwareConfig) -> DriveLaw:
    """The law ``name`` (of LAWS) of ``joint``'s drive."""
    function = law.control_law()
    sets = {"stance": config.stance, "swing": config.swing}
    return DriveLaw(
        name=name,
        function=function,
        program=program(function),
        counts=_quantities("counts", _COUNTS),
        state=_quantities("x", _STATE),
        input=_quantities("u", _INPUT),
        parameters=_quantities("p", _PARAMETERS),
        outputs=_quantities("y", _OUTPUTS),
        values=law.parameters(joint, config),
        gains={key: {"kp": g.kp, "ki": g.ki, "kd": g.kd} for key, g in sets.items()},
    )
