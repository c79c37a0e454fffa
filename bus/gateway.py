"""The gateway between the buses and the link: it forwards, and computes nothing."""

from __future__ import annotations

from typing import Any

from bus import messages
from bus.frames import Frame
from robots.description import Robot

LinkItem = tuple[int, int, bytes]  # bus, CAN identifier, data


class Gateway:
    """Forwards drive states and emergencies upwards, commands downwards."""

    def __init__(self, robot: Robot) -> None:
        nodes = [{joint.node_id for joint in robot.joints_of(bus)} for bus in robot.buses]
        self._upwards = [
            {base + node for base in (messages.STATE, messages.EMERGENCY) for node in ids} for ids in nodes
        ]
        self.ignored = 0  # heartbeats, and whatever else is on the buses

    def from_can(self, time_ns: int, bus: int, frame: Frame) -> LinkItem | None:
        """What goes to the controller for ``frame``, if anything."""
        if frame.id in self._upwards[bus] and not frame.extended:
            return bus, frame.id, frame.data
        self.ignored += 1
        return None

    def from_link(self, item: LinkItem) -> tuple[int, Frame]:
        """Bus and frame of a command."""
        bus, can_id, data = item
        return bus, Frame(can_id, data)

    def snapshot(self) -> Any:
        return self.ignored

    def restore(self, state: Any) -> None:
        self.ignored = state
