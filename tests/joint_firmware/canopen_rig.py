"""A stock CANopen master and one drive in one thread: what the master sends is heard in the drive's next tick, and
what the drive answers is there before the master waits for it. No clock, no threads."""

from __future__ import annotations

import io
import struct
from functools import lru_cache
from typing import Any

import canopen
from canopen.objectdictionary.eds import import_eds

from bus import messages
from bus.frames import Frame
from joint_firmware.config import TorqueGains
from joint_firmware.eds import eds

# gains of the drives here, so that the expected torques are easy numbers
GAINS = {"stance": TorqueGains(kp=1.0, kd="5 N m s/rad"), "swing": TorqueGains(kp=2.0, ki=10.0, kd="5 N m s/rad")}


@lru_cache
def object_dictionary(sheet: str, node_id: int) -> canopen.ObjectDictionary:
    return import_eds(io.StringIO(sheet), node_id)


class RigNetwork(canopen.Network):
    """``send_message`` and ``notify`` are what the package offers for a bus of one's own."""

    def __init__(self, bench: Any) -> None:
        super().__init__()
        self._bench = bench
        self.seen: list[Frame] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.run(1, Frame(can_id, bytes(data), fd=False, brs=False, remote=remote))

    def run(self, ticks: int, *frames: Frame) -> list[Frame]:
        """Let ``ticks`` pass, the first with ``frames``. Returns what the drive sent."""
        sent: list[Frame] = []
        for n in range(ticks):
            sent += self._bench.tick(*(frames if n == 0 else ()))
        for frame in sent:
            self.notify(frame.id, bytearray(frame.data), 0.0)
        self.seen += sent
        return sent


class Rig:
    """A booted drive (``bench``), its master's network, and the master's node for it, which knows the EDS."""

    def __init__(self, bench: Any, node: type[canopen.RemoteNode] = canopen.RemoteNode) -> None:
        self.bench = bench
        self.network = RigNetwork(bench)
        self.sheet = eds(bench.firmware.dictionary)
        self.node = node(bench.joint.node_id, object_dictionary(self.sheet, bench.joint.node_id))
        self.network.add_node(self.node)
        self.run = self.network.run

    def raw(self, request: bytes) -> list[bytes]:
        """Answers of the SDO server to one request of any form."""
        request_id, response_id = (base + self.node.id for base in (messages.SDO_REQUEST, messages.SDO_RESPONSE))
        sent = self.run(1, Frame(request_id, request, fd=False, brs=False))
        answers = [frame for frame in sent if frame.id == response_id]
        assert not any(frame.fd or frame.brs for frame in answers)  # in the form of the request
        return [frame.data for frame in answers]

    def abort_code(self, command: int, index: int = 0, sub: int = 0, data: bytes = b"") -> int | None:
        """Abort code of the answer to a request, None when it is not an abort."""
        (answer,) = self.raw(struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))
        return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else None

    def emergencies(self) -> list[tuple[int, int]]:
        """Code and register of those that the master has seen."""
        return [(e.code, e.register) for e in self.node.emcy.log]
