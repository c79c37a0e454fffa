"""The inline backend: the same nodes and the same bytes in one process, for sweeps and for a debugger."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bus.frames import Frame
from bus.zenoh_link import Bundle, decode_bundle, encode_bundle
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


def serve(controller: Controller, request: Bundle) -> bytes:
    """One tick of the controller, bundle in, bundle out: what travels over Zenoh in the processes backend."""
    for arrival, source, can_id, data in request.items:
        controller.receive(arrival, source, can_id, data)
    commands = controller.tick(request.time_ns)
    items = [(request.time_ns, bus, can_id, data) for bus, can_id, data in commands]
    return encode_bundle(request.sequence, request.time_ns, items, controller.telemetry)


def commands_of(reply: Bundle) -> list[Item]:
    """The commands in a controller's answer."""
    return [(source, can_id, data) for _, source, can_id, data in reply.items]


class InlineController:
    """The controller node, behind the same encoding as over Zenoh."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._sequence = 0
        self._answer = b""

    def start(self, now_ns: int, items: list[tuple[int, int, int, bytes]]) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self._answer = serve(self._controller, decode_bundle(encode_bundle(self._sequence, now_ns, items)))

    def finish(self) -> tuple[list[Item], np.ndarray]:
        reply = decode_bundle(self._answer)
        return commands_of(reply), reply.values

    def snapshot(self) -> Any:
        return self._controller.snapshot()

    def restore(self, state: Any) -> None:
        self._controller.restore(state)
