"""The clients of a stand-alone bus: every one has a port of the wire to itself."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections import deque
from typing import Any

from bus.frames import Frame
from bus.ports import Client, PortServer, peer
from bus.records import OWN, UNSEEN, pack_frame


class PortClient(Client):
    """A client with its port, and counts of what went over its socket."""

    def __init__(self, connection: socket.socket, pid: int, port: int) -> None:
        super().__init__(connection, pid)
        self.port = port
        self.sent = 0  # frames of its that were on the bus
        self.received = 0
        self.missed = 0  # frames that it was too slow for
        self.malformed = 0

    @property
    def done(self) -> bool:
        """It has left, and so has everything that it sent."""
        return self.left and not self.backlog and not self.flying

    def next_ns(self) -> int | None:
        """When the next frame of its periodic tasks is due."""
        return min((task.next_ns for task in self.tasks.values()), default=None)

    def summary(self) -> dict[str, Any]:
        try:
            with open(f"/proc/{self.pid}/comm", encoding="utf-8", errors="replace") as file:
                process = file.read().strip()
        except OSError:
            process = "?"
        counts = {key: getattr(self, key) for key in ("sent", "received", "missed", "malformed")}
        return {"port": self.port, "pid": self.pid, "process": process, **counts}


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
                pid, uid = peer(connection)
                if uid != os.getuid():
                    connection.close()
                    continue
                connection.setblocking(False)
                with contextlib.suppress(OSError):
                    connection.send(self._hello if self._unused else self._full)
                if not self._unused:
                    connection.close()
                    continue
                client = PortClient(connection, pid, self._unused.popleft())
                self.attached[client.port] = client
                self._clients.append(client)
                new.append(client)
        return new

    def hear(self, client: PortClient, now_ns: int) -> None:
        """Take in what ``client`` has sent; it may have left."""
        before, self._now_ns = self.malformed, now_ns
        self._listen_to(client, now_ns)
        client.malformed += self.malformed - before

    def due(self, client: PortClient, now_ns: int, room: int) -> list[Frame]:
        """What ``client`` wants on the bus now, at most ``room`` frames; they count as handed to the bus."""
        frames: list[Frame] = []
        flying, backlog = client.flying, client.backlog
        for number, task in list(client.tasks.items()):
            for frame in task.due(now_ns)[: max(room - len(frames), 0)]:  # what finds no place was due in vain
                flying.append((0, frame, now_ns))
                frames.append(frame)
            if task.finished:
                del client.tasks[number]
        while backlog and len(frames) < room:
            tag, frame = backlog.popleft()
            flying.append((tag, frame, now_ns))
            frames.append(frame)
        return frames

    def tell_rest(self, client: PortClient) -> None:
        """Tell what the client's socket did not take before."""
        while client.untold and self._send(client, client.untold[0]):
            client.untold.popleft()

    def unfit(self, client: PortClient, frame: Frame) -> None:
        """The bus cannot carry ``frame``, just handed to it."""
        n = next(n for n, (_, flying, _) in enumerate(client.flying) if flying is frame)
        self._tell_fate(client, UNSEEN, client.flying[n][0])
        del client.flying[n]

    def sent(self, client: PortClient, time_ns: int, delivered: list[Frame]) -> None:
        """A frame of ``client`` has been on the bus: one of those ``delivered`` just now, or, when it was lost or is
        delayed, by all appearance the one that wins the arbitration among those that wait."""
        flying = client.flying
        n = next((n for n, (_, frame, _) in enumerate(flying) if frame in delivered), None)
        if n is None:
            n = min(range(len(flying)), key=lambda i: _rank(flying[i][1]))
        else:
            delivered.remove(flying[n][1])
        tag, frame, _ = flying[n]
        del flying[n]
        client.sent += 1
        own = pack_frame(frame, time_ns, client.port, OWN, tag)
        if not client.left and (client.untold or not self._send(client, own)):
            client.untold.append(own)

    def deliver(self, time_ns: int, sender: int, frame: Frame) -> None:
        """Give ``frame`` to every client but its sender; one that does not keep up misses it."""
        record = pack_frame(frame, time_ns, sender)
        for client in self.attached.values():
            if client.port != sender and not client.left:
                if self._send(client, record):
                    client.received += 1
                else:
                    client.missed += 1

    def release(self, client: PortClient) -> None:
        """Give up the port of a client that is ``done``."""
        del self.attached[client.port]
        self._unused.append(client.port)
        self._departed.remove(client)


def _rank(frame: Frame) -> tuple[int, bool, int]:
    return (frame.id >> 18 if frame.extended else frame.id, frame.extended, frame.id)
