"""Ports on an emulated bus for any process of the same user: a Unix socket that carries the records of ``bus.records``.

All clients of a server share one CAN controller (one port of the wire), as all programs on one SocketCAN interface
do: its error counters and its transmit queue. A client can fill half of that queue: one that floods does not take
the place of the others.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import socket
from typing import Any

from bus.frames import ErrorFrame, Frame
from bus.port_client import Client, peer
from bus.records import VERSION, ControllerState, pack_error, pack_frame

_BACKLOG = 16
_MAX_CLIENTS = 64
_PREFIX = "hume-hil"


class PortError(RuntimeError):
    """A port cannot be opened or reached."""


def _address(run: str, channel: str) -> str:
    return f"\0{_PREFIX}/{os.getuid()}/{run}/{channel}"


class PortServer:
    """Serves one bus to other processes of the same user, at an abstract address that dies with this process.

    A client that does not keep up misses frames (``overruns``), but always learns what became of its own; what is
    not a record is dropped (``malformed``).

    Args:
        channel: name of the bus.
        run: name of the run, or of whatever else has buses.
        endpoint: where the run's Zenoh session listens.
        port: the wire's port that the clients share; without it a frame that a client has sent is also taken for
            its own when another node sends the same.
        about: what else a client is told when it attaches: ``notice``, what its program tells the user when it
            sends for the first time.
    """

    def __init__(
        self, channel: str, run: str, endpoint: str | None = None, port: int | None = None, **about: Any
    ) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.setblocking(False)
        try:
            self._listener.bind(_address(run, channel))
        except OSError as error:
            self._listener.close()
            if error.errno == errno.EADDRINUSE:
                raise PortError(f"a run named {run!r} serves {channel!r} already") from None
            raise PortError(f"{run!r}/{channel!r} cannot be served: {error}") from None
        self._listener.listen(_BACKLOG)
        hello = {"version": VERSION, "run": run, "channel": channel, "endpoint": endpoint, **about}
        self._hello = json.dumps(hello).encode()
        self._port = port
        self._clients: list[Client] = []
        self._departed: list[Client] = []  # gone, but what they sent has not been on the bus yet
        self._gone = [0, 0]  # overruns and malformed of those
        self._now_ns = 0
        self._turn = 0
        self._state = ControllerState(0, 0, 0)
        self.first_sender: int | None = None  # process whose frame was the first

    @property
    def clients(self) -> int:
        return len(self._clients)

    @property
    def overruns(self) -> int:
        """Records that slow clients missed."""
        return self._gone[0] + sum(client.missed for client in self._clients)

    @property
    def malformed(self) -> int:
        """What clients sent and was no record."""
        return self._gone[1] + sum(client.malformed for client in self._clients)

    def poll(self, now_ns: int | None = None) -> list[Frame]:
        """Let new clients in; return the frames that clients want on the bus now. Never blocks.

        ``now_ns`` is the bus time, by default that of the last frame; periodic sending goes by it.
        """
        if now_ns is None:
            now_ns = self._now_ns
        self._now_ns = now_ns
        self._admit()
        frames: list[Frame] = []
        clients = [*self._clients, *self._departed]
        self._turn += 1  # nobody is always first
        for n in range(len(clients)):
            client = clients[(n + self._turn) % len(clients)]
            if not client.left:
                client.hear(now_ns)
                if client.left:
                    self._depart(client)
            if not client.idle:
                due = client.due(now_ns)
                if due and self.first_sender is None:
                    self.first_sender = client.pid
                frames += due
            if not client.left:
                client.tell_state(self._state)
        if self._departed:
            self._departed = [client for client in self._departed if not client.idle]
        return frames

    def _admit(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                connection, _ = self._listener.accept()
                if peer(connection)[1] != os.getuid() or len(self._clients) + len(self._departed) >= _MAX_CLIENTS:
                    connection.close()
                    continue
                client = Client(connection)
                client.give(self._hello)
                self._clients.append(client)

    def _depart(self, client: Client) -> None:
        self._clients.remove(client)
        self._departed.append(client)
        self._gone[0] += client.missed
        self._gone[1] += client.malformed

    def refused(self, frame: Frame) -> None:
        """The transmit queue was full when ``frame``, of the last ``poll``, was offered: it is offered again later."""
        any(client.refused(frame) for client in (*self._clients, *self._departed))

    def broadcast(self, time_ns: int, sender: int, frame: Frame) -> None:
        """Send ``frame`` to all clients; one that does not keep up misses it. A client that has sent this
        frame is told that it is its own."""
        if not (self._clients or self._departed):
            return
        self._now_ns = time_ns
        origin = None
        if self._port is None or sender == self._port:
            for client in (*self._clients, *self._departed):
                if client.landed(time_ns, sender, frame):
                    origin = client
                    break
        record = pack_frame(frame, time_ns, sender)
        for client in self._clients:
            if client is not origin:
                client.give(record)

    def broadcast_error(self, time_ns: int, error: ErrorFrame, sender: int = 0) -> None:
        """Send an error frame to all clients."""
        record = pack_error(error, time_ns, sender)
        for client in self._clients:
            client.give(record)

    def set_state(self, tec: int, rec: int, state: int) -> None:
        """``ControllerState`` of the controller that the clients share; they are told of a change at the next
        ``poll``."""
        self._state = ControllerState(tec, rec, state)

    def close(self) -> None:
        for client in self._clients:
            client.close()
        self._clients.clear()
        self._departed.clear()
        self._listener.close()


def served() -> list[tuple[str, str]]:
    """(run, channel) of every bus that this user's processes serve."""
    pattern = re.compile(rf"@{_PREFIX}/{os.getuid()}/(.+)/([^/@]+)$")
    found = set()
    with open("/proc/net/unix", encoding="utf-8", errors="replace") as table:
        for line in table:
            match = pattern.search(line.rstrip("\n").rstrip("@"))
            if match:
                found.add((match.group(1), match.group(2)))
    return sorted(found)


def connect(channel: str, ask_only: bool = False) -> tuple[socket.socket, dict[str, Any]]:
    """Attach to ``channel`` ("left_leg", or "RUN/left_leg" when several runs go on). Returns socket and hello.

    With ``ask_only`` from a bound socket, by which a bus can tell that nobody wants to attach; it may hang up at once.

    Raises PortError with what there is.
    """
    there = served()
    run, _, name = channel.rpartition("/")
    matches = [(r, c) for r, c in there if c == name and (not run or r == run)]
    if not matches:
        listed = ", ".join(f"{r}/{c}" for r, c in there) or "none"
        raise PortError(f"no running emulation serves a bus {channel!r}; there is: {listed}")
    if len(matches) > 1:
        raise PortError(f"several runs serve {name!r}, name one: {', '.join('/'.join(m) for m in matches)}")
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.settimeout(2.0)
    try:
        if ask_only:
            connection.bind("")  # to an address of the kernel's choice
        connection.connect(_address(*matches[0]))
        if peer(connection)[1] != os.getuid():
            raise PortError(f"{channel!r} is served by another user")
        hello = json.loads(connection.recv(4096))
        version = hello["version"]
    except PortError:
        connection.close()
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        connection.close()
        raise PortError(f"{channel!r} does not answer ({error})") from None
    if version != VERSION:
        connection.close()
        raise PortError(f"{channel!r} speaks version {version}, this is {VERSION}")
    if "refused" in hello and not ask_only:
        connection.close()
        raise PortError(f"{channel!r} {hello['refused']}")
    return connection, hello


def find_runs() -> dict[str, dict[str, Any]]:
    """The hello of every run of this user by its name."""
    runs: dict[str, dict[str, Any]] = {}
    for run, channel in served():
        if run in runs:
            continue
        with contextlib.suppress(PortError):
            connection, hello = connect(f"{run}/{channel}", ask_only=True)
            connection.close()
            runs[run] = hello
    return runs
