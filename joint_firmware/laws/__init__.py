"""The control law of a drive, assembled from blocks."""

from joint_firmware.laws.block import Offsets
from joint_firmware.laws.catalogue import TORQUE_LOOPS, torque_loop_function
from joint_firmware.laws.drive_law import DriveLaw, doubts, drive_law

__all__ = ["TORQUE_LOOPS", "DriveLaw", "Offsets", "doubts", "drive_law", "torque_loop_function"]
