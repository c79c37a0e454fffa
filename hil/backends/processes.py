"""The processes backend: every joint and the controller in an operating-system process of its own.

Pins and CAN frames travel in anonymous shared memory, which vanishes with its processes; the controller is reached
only through Zenoh. The launcher hosts the world, the calendar, the wires and the gateway: a hop to another process
costs more than either of the latter computes (docs/architecture.md has the measurement).
"""

from __future__ import annotations

import mmap
import os
import socket
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh

from bus.frames import Frame
from bus.python_can import HilBus
from bus.shm_port import ShmPort
from bus.zenoh_link import (
    Bundle,
    MalformedBundleError,
    Refused,
    declare_publisher,
    decode_bundle,
    encode_bundle,
    keys,
    peer_config,
    session_config,
)
from hil.backends.lifecycle import Family, quiet_collector
from hil.backends.state_pipe import connections, receive, serve_pipe
from hil.errors import EmulationError
from hil.system import Item
from robots import pins

if TYPE_CHECKING:
    from hil.scenario import Scenario
    from joint_firmware.firmware import JointFirmware

_TICK, _SERVE_PIPE, _IDLE = 0, 1, 2
_JOINT_BLOCK = 256  # bytes: order, pins
_TIME, _WHAT, _DONE = 0, 1, 2  # words of an order: now (ns), what to do, how many orders have been done


class SharedPins:
    """The shared memory of the joints: per joint its order, its pins and the two rings of its CAN port."""

    def __init__(self, joints: int) -> None:
        self._stride = _JOINT_BLOCK + ShmPort.SIZE
        self._memory = mmap.mmap(-1, joints * self._stride)
        view = memoryview(self._memory)
        blocks = [view[j * self._stride : (j + 1) * self._stride] for j in range(joints)]
        self.orders = [block[:24].cast("q") for block in blocks]
        whole = np.frombuffer(self._memory, np.int32).reshape(joints, self._stride // 4)
        self.inputs = whole[:, 8 : 8 + pins.N_INPUTS]
        self.outputs = whole[:, 24 : 24 + pins.N_OUTPUTS]
        self.ports = [block[_JOINT_BLOCK:] for block in blocks]


class ProcessJoints:
    """The joint nodes, each in its own process.

    One wakes the next, and the launcher sees in shared memory when the last is done: to wake a process on
    another core costs ten times what it costs on the same one.
    """

    def __init__(
        self,
        family: Family,
        nodes: Sequence[JointFirmware],
        names: Sequence[str],
        channels: Sequence[str],
        shared: SharedPins,
    ) -> None:
        self._family = family
        self._orders = shared.orders
        self._last = shared.orders[-1]
        self._ordered = 0
        self._idle: Sequence[int] = ()
        go = [os.eventfd(0) for _ in nodes]
        self._first = go[0]
        self._ports = [ShmPort(memory) for memory in shared.ports]  # the wire's side
        self._pipes: list[Connection] = []
        for j, (node, name) in enumerate(zip(nodes, names, strict=True)):
            node.attach(shared.inputs[j], shared.outputs[j])
            ours, theirs = connections()
            self._pipes.append(ours)
            port = self._firmware_port(j, channels[j], shared)
            following = go[j + 1] if j + 1 < len(go) else None
            family.spawn(name, _joint_main, node, port, shared.orders[j], go[j], following, theirs)
            port.shutdown()  # the joint's process has its own

    def _firmware_port(self, joint: int, channel: str, shared: SharedPins) -> Any:
        """What a joint's firmware is given: ``recv_frames()``, ``send_frame(frame)``, ``shutdown()``."""
        return HilBus(channel=channel, port=ShmPort(shared.ports[joint], firmware=True))

    def start(self, now_ns: int, inboxes: list[list[Frame]], idle: Sequence[int] = ()) -> None:
        self._idle = idle
        for joint in idle:
            self._orders[joint][_WHAT] = _IDLE
        for order, port, inbox in zip(self._orders, self._ports, inboxes, strict=True):
            for frame in inbox:
                port.send_frame(frame)
            order[_TIME] = now_ns
        self._order()

    def finish(self) -> list[list[Frame]]:
        self._family.wait(self._done, "the joints")
        for joint in self._idle:
            self._orders[joint][_WHAT] = _TICK
        return [port.recv_frames() for port in self._ports]

    def _order(self) -> None:
        self._ordered += 1
        os.eventfd_write(self._first, 1)

    def _done(self) -> bool | None:
        return True if self._last[_DONE] == self._ordered else None

    def _ask(self, requests: Sequence[tuple[str, Any]]) -> list[Any]:
        for order in self._orders:
            order[_WHAT] = _SERVE_PIPE
        self._order()
        answers = []
        for pipe, request in zip(self._pipes, requests, strict=True):
            pipe.send(request)
            answers.append(receive(self._family, pipe))
        self._family.wait(self._done, "the joints")
        for order in self._orders:
            order[_WHAT] = _TICK
        return answers

    def snapshot(self) -> list[Any]:
        return self._ask([("snapshot", None)] * len(self._pipes))

    def restore(self, states: list[Any]) -> None:
        self._ask([("restore", state) for state in states])


def _joint_main(
    node: JointFirmware,
    port: Any,
    order: memoryview,
    go: int,
    following: int | None,
    pipe: Connection,
) -> None:
    quiet_collector()
    wait, wake = os.eventfd_read, os.eventfd_write
    recv_frames, send, tick = port.recv_frames, port.send_frame, node.tick
    while True:
        wait(go)
        if order[_WHAT] == _TICK:
            for frame in tick(order[_TIME], recv_frames()):
                send(frame)
        elif order[_WHAT] == _SERVE_PIPE:
            serve_pipe(node, pipe)
        order[_DONE] += 1
        if following is not None:
            wake(following, 1)


class ProcessController:
    """The controller in its own process, behind Zenoh: one sample with all that arrived, one sample as the answer.

    Answers are awaited by their sequence number; any other sample is counted in ``refused`` and ignored.

    Args:
        where: where to meet, as of ``bus.zenoh_link.peer_config``; None: a session of this run's own, on loopback.
    """

    def __init__(self, family: Family, run: str, scenario: Scenario, where: str | None) -> None:
        self._family = family
        self._run = run
        self._sequence = 0
        self.refused = Refused()
        self.session: zenoh.Session | None = None
        self.endpoint = where or f"tcp/127.0.0.1:{free_port()}"
        self._own = where is None
        self._pipe, theirs = connections()
        family.execute("controller", "hil.backends.controller_node", theirs)
        self._pipe.send((run, scenario.robot, scenario.controller))

    def open(self, values: int) -> zenoh.Session:
        """Open the launcher's session (after all children were forked: a session has threads) and meet the
        controller's, whose answers carry ``values`` numbers. Returns the session."""
        self._values = values
        config = session_config(self.endpoint, None) if self._own else peer_config(self.endpoint)
        try:
            self.session = zenoh.open(config)
        except zenoh.ZError as error:
            raise EmulationError(f"Zenoh could not be opened at {self.endpoint}: {error}") from None
        names = keys(self._run)
        self._subscriber = self.session.declare_subscriber(names.command, zenoh.handlers.FifoChannel(64))
        self._poll = self._subscriber.handler.try_recv
        self._publisher = declare_publisher(self.session, names.state)
        self._pipe.send(self.endpoint)
        receive(self._family, self._pipe)  # its session stands, its controller is built
        while not self._publisher.matching_status.matching:
            self._family.check()
            time.sleep(0.001)  # with real-time priority on one core, a busy wait would keep the other end from coming
        return self.session

    def close(self) -> None:
        """Undeclare and close: a session left open would keep the process from ending."""
        if self.session is not None:
            self._subscriber.undeclare()
            self.session.close()
            self.session = None

    def start(self, now_ns: int, items: list[tuple[int, int, int, bytes]]) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self._publisher.put(encode_bundle(self._sequence, now_ns, items))

    def finish(self) -> tuple[list[Item], np.ndarray]:
        reply = self._family.wait(self._answer, "the controller")
        return [(bus, can_id, data) for _, bus, can_id, data in reply.items], reply.values

    def _answer(self) -> Bundle | None:
        """The awaited answer, if it has come."""
        sample = self._poll()
        if sample is None:
            return None
        try:
            reply = decode_bundle(sample.payload.to_bytes())
        except MalformedBundleError as error:
            self.refused.count(error)
            return None
        if reply.sequence == self._sequence and len(reply.values) == self._values:
            return reply
        self.refused.unexpected += 1
        return None

    def _ask(self, request: tuple[str, Any]) -> Any:
        self._pipe.send(request)
        self._publisher.put(b"")  # an empty sample: look at the pipe
        return receive(self._family, self._pipe)

    def snapshot(self) -> Any:
        return self._ask(("snapshot", None))

    def restore(self, state: Any) -> None:
        self._ask(("restore", state))

    def link_report(self) -> dict[str, dict[str, int]]:
        """Samples that were ignored, at either end of the link, by reason."""
        return {"launcher": self.refused.report(), "controller": self._ask(("refused", None))}


def free_port() -> int:
    """A port of the loopback that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
