"""How the joints' frames get onto the wires: at once and as they are, unless a fault of the node has it otherwise."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from typing import Any

from bus.frames import Frame
from bus.impairment import NEVER
from bus.wire import Wire
from hil.node_clock import DriftingClock

_NODE_ID = 0x7F  # bits of an identifier that name the node (CiA 301, pre-defined connection set)
# by joint with a clock of its own: when it ticks within one tick of the world, ns after that
Offsets = Mapping[int, list[int]]
_NONE: Offsets = {}


class Senders:
    """Offers frames of joints to their wires, and keeps those that a drifting clock sends later than the tick.

    places: (bus, port) by joint.
    """

    def __init__(self, wires: Sequence[Wire], places: Mapping[int, tuple[int, int]], isr_rate: int) -> None:
        self._wires, self._places = wires, places
        self._period_ns = 1e9 / isr_rate
        self.clocks: dict[int, DriftingClock] = {}
        self._node_ids: dict[int, int] = {}  # of joints that send with another's
        self._late: list[tuple[int, int, int, Frame]] = []  # time, sequence, joint, frame
        self._sequence = 0
        self.next_ns = NEVER

    def set_drift(self, joint: int, ppm: float, ticks: int) -> None:
        """Let the clock of ``joint``, which has ticked ``ticks`` times, run fast by ``ppm``."""
        if joint not in self.clocks:
            if ppm == 0:
                return
            self.clocks[joint] = DriftingClock(self._period_ns, ticks)
        self.clocks[joint].set(ppm)

    def set_node_id(self, joint: int, node_id: int) -> None:
        """Let ``joint`` send with the identifiers of node ``node_id``; 0: its own."""
        if node_id:
            self._node_ids[joint] = node_id
        else:
            self._node_ids.pop(joint, None)

    def offsets(self, now_ns: int) -> Offsets:
        """When the joints that have clocks of their own tick within the world's tick at ``now_ns``."""
        return {joint: clock.offsets(now_ns) for joint, clock in self.clocks.items()}

    def offer(
        self, now_ns: int, outboxes: Sequence[Sequence[Frame]], offsets: Offsets = _NONE, tick: int = 0
    ) -> None:
        """What the joints have sent in their first (0) or second (1) tick within one of the world."""
        node_ids = self._node_ids
        for joint, frames in enumerate(outboxes):
            if frames:
                bus, port = self._places[joint]
                if node_ids and joint in node_ids:
                    frames = [frame._replace(id=frame.id & ~_NODE_ID | node_ids[joint]) for frame in frames]
                if joint in offsets:
                    self._keep(now_ns + offsets[joint][tick], joint, frames)
                    continue
                for frame in frames:
                    self._wires[bus].offer(now_ns, port, frame)

    def _keep(self, time_ns: int, joint: int, frames: Sequence[Frame]) -> None:
        for frame in frames:
            self._sequence += 1
            heapq.heappush(self._late, (time_ns, self._sequence, joint, frame))
        self.next_ns = self._late[0][0]

    def advance(self, now_ns: int) -> None:
        """Offer what was kept until ``now_ns``."""
        late = self._late
        while late and late[0][0] <= now_ns:
            _, _, joint, frame = heapq.heappop(late)
            bus, port = self._places[joint]
            self._wires[bus].offer(now_ns, port, frame)
        self.next_ns = late[0][0] if late else NEVER

    def snapshot(self) -> dict[str, Any]:
        return {
            "clocks": {joint: clock.snapshot() for joint, clock in self.clocks.items()},
            "node_ids": dict(self._node_ids),
            "late": list(self._late),
            "sequence": self._sequence,
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.clocks = {}
        for joint, saved in state["clocks"].items():
            self.clocks[joint] = DriftingClock(self._period_ns, 0)
            self.clocks[joint].restore(saved)
        self._node_ids = dict(state["node_ids"])
        self._late = list(state["late"])
        self._sequence = state["sequence"]
        self.next_ns = self._late[0][0] if self._late else NEVER
