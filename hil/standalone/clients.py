"""The clients of a stand-alone bus: every one has a port of the wire to itself."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections import deque
from typing import Any

from bus.frames import Frame
from bus.ports import RECORD_SIZE, MalformedRecordError, PortServer, pack_frame, peer, unpack_frame


class Client:
    """One attached socket and what went over it."""

    def __init__(self, connection: socket.socket, port: int) -> None:
        self.socket = connection
        self.port = port
        self.pid = peer(connection)[0]
        self.sent = 0  # frames taken from it
        self.received = 0
        self.missed = 0  # frames that it was too slow for
        self.malformed = 0

    def take(self) -> Frame | None:
        """The next frame that it has sent, None when there is none. Raises ConnectionError when it has gone."""
        while True:
            try:
                record = self.socket.recv(RECORD_SIZE + 1)
            except BlockingIOError:
                return None
            except ConnectionResetError:
                continue  # it left without reading all; what it sent before is still there, then the end
            if not record:
                raise ConnectionError
            try:
                frame = unpack_frame(record)[2]
            except MalformedRecordError:
                self.malformed += 1
                continue
            self.sent += 1
            return frame

    def give(self, record: bytes) -> None:
        """Send it a record; it misses what it has no room for."""
        try:
            self.socket.send(record)
            self.received += 1
        except BlockingIOError:
            self.missed += 1
        except OSError:
            pass  # it has gone; what it sent before is still to be taken, and ``take`` will see the end

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
        self.attached: dict[int, Client] = {}  # by port
        self._free = deque(range(ports))  # the one longest free comes first: nothing of its last user is under way
        refusal = f"has {ports} clients already and takes no more"
        self._full = json.dumps({**json.loads(self._hello), "refused": refusal}).encode()

    def fileno(self) -> int:
        """Readable when somebody wants to attach."""
        return self._listener.fileno()

    def accept(self) -> list[Client]:
        """Let in who waits at the door: processes of the same user, while there are ports."""
        new = []
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                connection, _ = self._listener.accept()
                if peer(connection)[1] != os.getuid():
                    connection.close()
                    continue
                connection.setblocking(False)
                with contextlib.suppress(OSError):
                    connection.send(self._hello if self._free else self._full)
                if not self._free:
                    connection.close()
                    continue
                client = Client(connection, self._free.popleft())
                self.attached[client.port] = client
                new.append(client)
        return new

    def deliver(self, time_ns: int, sender: int, frame: Frame) -> None:
        """Give ``frame`` to every client; its sender is told that it is its own."""
        record = pack_frame(frame, time_ns, sender)
        for client in self.attached.values():
            client.give(record if client.port != sender else pack_frame(frame, time_ns, sender, own=True))

    def release(self, client: Client) -> None:
        """Give up a client that has gone."""
        del self.attached[client.port]
        self._free.append(client.port)
        client.socket.close()

    def close(self) -> None:
        for client in list(self.attached.values()):
            self.release(client)
        super().close()
