"""The torque loops by name, as ``firmware.law`` names them."""

from __future__ import annotations

import casadi as ca

from joint_firmware.laws.cascade import Cascade
from joint_firmware.laws.disturbance_observer import PDmDOB
from joint_firmware.laws.pd_f import PDf
from joint_firmware.laws.pid_m import PDm, PIDm
from joint_firmware.laws.torque_loop import TorqueLoop, loop_function
from joint_firmware.laws.valve import Valve

TORQUE_LOOPS: dict[str, TorqueLoop] = {loop.name: loop for loop in (PDf(), PDm(), PIDm(), PDmDOB(), Cascade(), Valve())}


def torque_loop_function(name: str) -> ca.Function:
    """The torque loop ``name`` alone: see ``loop_function``. Raises KeyError for an unknown name."""
    return loop_function(TORQUE_LOOPS[name])
