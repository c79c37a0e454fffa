"""The clients of a stand-alone bus: every one has a port of the wire to itself."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections import deque
from collections.abc import Sequence
from typing import Any

from bus.frames import Frame
from bus.port_client import Client, peer
from bus.ports import PortServer
from bus.records import UNSEEN, pack_frame


class PortClient(Client):
    """A client with a port of its own."""

    def __init__(self, connection: socket.socket, port: int) -> None:
        super().__init__(connection)
        self.port = port

    @property
    def in_wire(self) -> int:
        """How many frames the wire has from it."""
        return len(self._flying)

    def completed(self, time_ns: int, delivered: Sequence[Frame]) -> None:
        """One of its frames has been on the bus: one of those just ``delivered``, or, when it was lost or is delayed,
        by all appearance the one that wins the arbitration among those that wait."""
        waiting = [frame for _, frame, _ in self._flying]
        frame = next((frame for frame in waiting if frame in delivered), None) or min(waiting, key=_rank)
        self.landed(time_ns, self.port, frame)

    def unfit(self, frame: Frame, now_ns: int) -> None:
        """The bus does not carry ``frame``, which was due."""
        n = next(n for n, (_, sent, _) in enumerate(self._flying) if sent is frame)
        self._tell_fate(UNSEEN, self._flying[n][0], now_ns)
        del self._flying[n]

    def summary(self) -> dict[str, Any]:
        try:
            with open(f"/proc/{self.pid}/comm", encoding="utf-8", errors="replace") as file:
                process = file.read().strip()
        except OSError:
            process = "?"
        counts = {key: getattr(self, key) for key in ("sent", "received", "missed", "malformed")}
        return {"port": self.port, "pid": self.pid, "process": process, **counts}


def _rank(frame: Frame) -> tuple[int, bool, int]:
    return (frame.id >> 18 if frame.extended else frame.id, frame.extended, frame.id)


class ClientPorts(PortServer):
    """Serves a bus by its name alone, to at most ``ports`` clients at a time."""

    def __init__(self, name: str, ports: int, endpoint: str | None, **about: Any) -> None:
        super().__init__(name, name, endpoint, **about)
        self.attached: dict[int, PortClient] = {}  # by port
        self._unused = deque(range(ports))  # the one longest free comes first
        refusal = f"has {ports} clients already and takes no more"
        self._full = json.dumps({**json.loads(self._hello), "refused": refusal}).encode()

    def fileno(self) -> int:
        """Readable when somebody wants to attach."""
        return self._listener.fileno()

    def accept(self) -> list[PortClient]:
        """Let in who waits at the door: processes of the same user, while there are ports."""
        new = []
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                connection, _ = self._listener.accept()
                if peer(connection)[1] != os.getuid():
                    connection.close()
                elif not self._unused:
                    with contextlib.suppress(OSError):
                        connection.send(self._full)
                    connection.close()
                else:
                    client = PortClient(connection, self._unused.popleft())
                    client.give(self._hello)
                    self.attached[client.port] = client
                    new.append(client)
        return new

    def deliver(self, time_ns: int, sender: int, frame: Frame, missed: int) -> None:
        """Give ``frame`` to every client but its sender, and the ports whose bits of ``missed`` are set."""
        record = pack_frame(frame, time_ns, sender)
        for client in self.attached.values():
            if client.port != sender and not client.left and not missed >> client.port & 1:
                client.give(record)

    def release(self, client: PortClient) -> None:
        """Give up the port of a client that has left, and whose frames have been on the bus."""
        del self.attached[client.port]
        self._unused.append(client.port)

    def close(self) -> None:
        for client in self.attached.values():
            client.close()
        super().close()
