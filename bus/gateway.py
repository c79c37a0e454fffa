"""The gateway between the buses and the link: it forwards, and computes nothing."""

from __future__ import annotations

from typing import Any

from bus import messages
from bus.frames import Frame
from bus.messages import MalformedMessageError
from robots.description import Robot

LinkItem = tuple[int, int, bytes]  # bus, CAN identifier, data


class Gateway:
    """Forwards drive states and emergencies upwards, commands downwards.

    ``ignored`` counts heartbeats and whatever else is on the buses, ``malformed`` what has a known identifier
    but not its length.
    """

    def __init__(self, robot: Robot) -> None:
        nodes = [{joint.node_id for joint in robot.joints_of(bus)} for bus in robot.buses]
        lengths = {messages.STATE: messages.STATE_LENGTH, messages.EMERGENCY: messages.EMERGENCY_LENGTH}
        self._upwards = [{base + node: n for base, n in lengths.items() for node in ids} for ids in nodes]
        self.ignored = 0
        self.malformed = 0

    def from_can(self, time_ns: int, bus: int, frame: Frame) -> LinkItem | None:
        """What goes to the controller for ``frame``, if anything."""
        length = self._upwards[bus].get(frame.id)
        if length is None or frame.extended:
            self.ignored += 1
            return None
        if len(frame.data) != length:
            self.malformed += 1
            return None
        return bus, frame.id, frame.data

    def from_link(self, item: LinkItem) -> tuple[int, Frame]:
        """Bus and frame of a command. Raises MalformedMessageError for anything else."""
        bus, can_id, data = item
        if bus >= len(self._upwards) or can_id != messages.COMMAND or len(data) != messages.COMMAND_LENGTH:
            self.malformed += 1
            raise MalformedMessageError(f"no command: {len(data)} bytes, identifier {can_id:#x}, bus {bus}")
        return bus, Frame(can_id, data)

    def snapshot(self) -> Any:
        return self.ignored, self.malformed

    def restore(self, state: Any) -> None:
        self.ignored, self.malformed = state
