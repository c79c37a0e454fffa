"""The torque loops by name, as ``firmware.law`` names them."""

from __future__ import annotations

import casadi as ca

from joint_firmware.laws.pid_m import PDm, PIDm
from joint_firmware.laws.torque_loop import TorqueLoop, loop_function

TORQUE_LOOPS: dict[str, TorqueLoop] = {loop.name: loop for loop in (PDm(), PIDm())}


def torque_loop_function(name: str) -> ca.Function:
    """The torque loop ``name`` alone: see ``loop_function``. Raises KeyError for an unknown name."""
    return loop_function(TORQUE_LOOPS[name])
