"""Between sensing and reference: what the signals say about the drive's health."""

from __future__ import annotations

import casadi as ca

from joint_firmware.laws.block import Block, Symbols
from joint_firmware.laws.signals import Sensed


class Monitor(Block):
    """Gives the trip word, 0 while all is well, and the share of the current limit that may be used (0 … 1)."""

    def watch(self, counts: ca.SX, sensed: Sensed, x: Symbols, p: Symbols) -> tuple[ca.SX, ca.SX | float, Symbols]:
        """Trip word, derating, and the states of the next tick."""
        return ca.SX(0), 1.0, Symbols()
