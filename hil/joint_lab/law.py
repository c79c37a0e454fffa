"""A drive's law, linearised where it is implemented, so that theory and firmware cannot part."""

from __future__ import annotations

import math

import numpy as np

from hil.joint_lab.actuator import StateSpace
from hil.joint_lab.sampled import SampledLaw
from joint_firmware.config import FirmwareConfig
from robots.description import Joint


def sampled_law(joint: Joint, firmware: FirmwareConfig) -> SampledLaw:
    """INTERIM by hand."""
    per = 1 / firmware.rate
    al = 1 - math.exp(-2 * math.pi * firmware.velocity_cutoff * per)
    kp, ki, kd, k = firmware.stance.kp, firmware.stance.ki, firmware.stance.kd, joint.actuator.stiffness
    F = np.array([[0, 0, 0], [-al / per, 1 - al, 0], [0, 0, 1]])
    G = np.array([[1, 0, 0], [al / per, 0, 0], [0, -ki * per * k, ki * per]])
    H = -kd * F[1:2] + np.array([[0, 0, 1]])
    J = np.array([[-kd * al / per, -kp * k, 1 + kp]])
    return SampledLaw(StateSpace(F, G, H, J), per)
