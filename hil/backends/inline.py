"""The inline backend: the same nodes and the same frames in one process, for sweeps and for a debugger.

What the other backend packs for Zenoh goes from hand to hand here: a bundle is read as it was written.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bus.frames import Frame
from hil.system import Item

if TYPE_CHECKING:
    from central_controller.controller import Controller
    from joint_firmware.firmware import JointFirmware


class InlineJoints:
    """All joint nodes, called one after the other."""

    def __init__(self, nodes: Sequence[JointFirmware], pins_in: np.ndarray, pins_out: np.ndarray) -> None:
        self.nodes = list(nodes)
        for node, inputs, outputs in zip(nodes, pins_in, pins_out, strict=True):
            node.attach(inputs, outputs)
        self._sent: list[list[Frame]] = []

    def start(self, now_ns: int, inboxes: list[list[Frame]], idle: Sequence[int] = ()) -> None:
        self._sent = [
            [] if idle and joint in idle else node.tick(now_ns, inbox)
            for joint, (node, inbox) in enumerate(zip(self.nodes, inboxes, strict=True))
        ]

    def finish(self) -> list[list[Frame]]:
        return self._sent

    def snapshot(self) -> list[Any]:
        return [node.snapshot() for node in self.nodes]

    def restore(self, states: list[Any]) -> None:
        for node, state in zip(self.nodes, states, strict=True):
            node.restore(state)


def tick(controller: Controller, time_ns: int, items: Iterable[tuple[int, int, int, bytes]]) -> list[Item]:
    """One tick of the controller: its commands for what has arrived."""
    receive = controller.receive
    for arrival, source, can_id, data in items:
        receive(arrival, source, can_id, data)
    return controller.tick(time_ns)


class InlineController:
    """The controller node."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._commands: list[Item] = []

    def start(self, now_ns: int, items: list[tuple[int, int, int, bytes]]) -> None:
        self._commands = tick(self._controller, now_ns, items)

    def finish(self) -> tuple[list[Item], np.ndarray]:
        return self._commands, self._controller.telemetry

    def snapshot(self) -> Any:
        return self._controller.snapshot()

    def restore(self, state: Any) -> None:
        self._controller.restore(state)
