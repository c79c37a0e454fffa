"""In place of a joint's firmware, when that joint is real hardware on a CAN interface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bus import messages
from bus.frames import Frame
from bus.messages import Statusword
from robots import pins
from robots.description import Joint

_POWERED = (Statusword.OPERATION_ENABLED, Statusword.QUICK_STOP_ACTIVE, Statusword.FAULT_REACTION_ACTIVE)


class ExternalJoint:
    """Sends nothing; drives the plant's joint with the current that the real drive reports.

    So the plant's joint and the real one have the same motor current, but each its own load: the robot in the plant
    stands only as far as the real joint is loaded like the plant's.
    """

    def __init__(self, joint: Joint) -> None:
        self.name, self.node_id = joint.name, joint.node_id
        self._state_id = messages.STATE + joint.node_id
        self.malformed = 0

    def attach(self, pins_in: np.ndarray, pins_out: np.ndarray) -> None:
        """Connect the pins, as of ``JointFirmware``; the inputs are not read."""
        self._out = pins_out

    def tick(self, now_ns: int, frames: Sequence[Frame]) -> list[Frame]:
        """Look at what the real drive has sent."""
        for frame in frames:
            if frame.id != self._state_id or frame.extended:
                continue
            try:
                state = messages.decode_state(frame.data)
            except messages.MalformedMessageError:
                self.malformed += 1
                continue
            powered = state.statusword & Statusword.MASK in _POWERED
            self._out[pins.ENABLE] = int(powered)
            self._out[pins.CURRENT_DEMAND] = round(state.current / pins.AMPERE_PER_COUNT) if powered else 0
        return []

    def snapshot(self) -> Any:
        """Nothing: the state of hardware cannot be saved."""
        return None

    def restore(self, state: Any) -> None:
        """Nothing: the state of hardware cannot be restored."""
