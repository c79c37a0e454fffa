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
from bus.link import NEVER
from bus.port_client import UNSEEN_NS, Client, peer
from bus.ports import PortServer
from bus.records import UNSEEN, pack_frame


def node_name(port: int) -> str:
    """What the client at ``port`` is called."""
    return f"port{port}"


class PortClient(Client):
    """A client with a port of its own."""

    def __init__(self, connection: socket.socket, port: int) -> None:
        super().__init__(connection)
        self.port = port
        self.node = node_name(port)
        self.faults: dict[str, Any] = {}  # what is wrong with it, by key
        self.process = _command(self.pid)

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

    @property
    def starved(self) -> bool:
        """Whether a frame waits that it was told of that it had not been on the bus in time."""
        return any(since == NEVER for _, _, since in self._flying)

    def _tell_unseen(self, now_ns: int) -> None:
        """The wire knows what has been on the bus: a frame that has not still waits there, and keeps its place."""
        for n, (tag, frame, since) in enumerate(self._flying):
            if since <= now_ns - UNSEEN_NS:
                self._tell_fate(UNSEEN, tag, now_ns)
                self._flying[n] = (0, frame, NEVER)

    def next_ns(self) -> int:
        oldest = min((since for _, _, since in self._flying), default=NEVER)
        return min(super().next_ns(), oldest if oldest == NEVER else oldest + UNSEEN_NS)

    def given_up(self, frame: Frame, now_ns: int) -> None:
        """``frame``, which was due, will not be on the bus any more."""
        n = next((n for n, (_, sent, _) in enumerate(self._flying) if sent == frame), None)
        if n is not None:
            self._tell_fate(UNSEEN, self._flying[n][0], now_ns)
            del self._flying[n]

    def abandon(self) -> None:
        """Forget what it has sent."""
        self._backlog.clear()
        self._flying.clear()

    def summary(self) -> dict[str, Any]:
        """Who it is, and how many frames it has had to do with."""
        counts = {key: getattr(self, key) for key in ("sent", "received", "missed", "malformed")}
        about = {"node": self.node, "port": self.port, "pid": self.pid, "process": self.process}
        return {**about, **counts, "faults": dict(self.faults)}


def _command(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/comm", encoding="utf-8", errors="replace") as file:
            return file.read().strip()
    except OSError:
        return "?"


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
                connection, bound_to = self._listener.accept()
                if peer(connection)[1] != os.getuid():
                    connection.close()
                elif bound_to:  # it only asks: no node of the bus, which would acknowledge
                    self._answer(connection, self._hello)
                elif not self._unused:
                    self._answer(connection, self._full)
                else:
                    client = PortClient(connection, self._unused.popleft())
                    client.give(json.dumps({**json.loads(self._hello), "node": client.node}).encode())
                    self.attached[client.port] = client
                    new.append(client)
        return new

    @staticmethod
    def _answer(connection: socket.socket, hello: bytes) -> None:
        with contextlib.suppress(OSError):
            connection.send(hello)
        connection.close()

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
