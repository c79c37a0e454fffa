"""Ports on an emulated bus for any process of the same user: a Unix socket that carries the records of ``bus.records``.

All clients of a server share one CAN controller (one port of the wire), as all programs on one SocketCAN interface
do: its error counters and its transmit queue. A client hands over at most ``WINDOW`` frames whose fate it does not
know yet, and at most ``IN_FLIGHT`` of them wait in the controller, half of its queue: one that floods does not take
the place of the others.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import socket
import struct
from collections import deque
from typing import Any

from bus.frames import ErrorFrame, Frame
from bus.periodic import Task
from bus.records import (
    FLUSH,
    FLUSHED,
    FRAME,
    LARGEST,
    OWN,
    PERIODIC,
    STOP,
    UNSEEN,
    VERSION,
    ControllerState,
    MalformedRecordError,
    kind_and_tag,
    pack_error,
    pack_frame,
    pack_note,
    pack_state,
    unpack_frame,
    unpack_task,
)

WINDOW = 64  # frames of a client whose fate it does not know
IN_FLIGHT = 16  # frames of a client that wait in the controller
_UNSEEN_NS = 1_000_000_000  # bus time after which a frame that was not on the bus is given up
_BACKLOG = 16
_MAX_CLIENTS = 64
_MAX_TASKS = 64
_MAX_RECORDS = 2 * WINDOW  # that a client is heard for in one poll
_PREFIX = "hume-hil"


class PortError(RuntimeError):
    """A port cannot be opened or reached."""


def _address(run: str, channel: str) -> str:
    return f"\0{_PREFIX}/{os.getuid()}/{run}/{channel}"


def peer(connection: socket.socket) -> tuple[int, int]:
    """Process and user at the other end."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, _ = struct.unpack("3i", credentials)
    return pid, uid


class Client:
    """A process that is attached, and what it has sent."""

    def __init__(self, connection: socket.socket, pid: int) -> None:
        self.connection = connection
        self.pid = pid
        self.left = False
        self.backlog: deque[tuple[int, Frame]] = deque()  # tag and frame, not yet handed to the bus
        self.flying: deque[tuple[int, Frame, int]] = deque()  # handed to the bus at that time, not yet seen on it
        self.untold: deque[bytes] = deque()  # records about its own frames that its socket did not take
        self.tasks: dict[int, Task] = {}
        self.state: ControllerState | None = None  # as it was told


class PortServer:
    """Serves one bus to other processes of the same user, at an abstract address that dies with this process.

    A client that does not keep up misses frames (``overruns``), but always learns what became of its own; what is
    not a record is dropped (``malformed``).

    Args:
        channel: name of the bus.
        run: name of the run, or of whatever else has buses.
        endpoint: where the run's Zenoh session listens.
        notice: what a client is told when it sends for the first time.
        port: the wire's port that the clients share; without it a frame that a client has sent is also taken for
            its own when another node sends the same.
        about: what else a client is told when it attaches.
    """

    def __init__(
        self, channel: str, run: str, endpoint: str | None = None, notice: str | None = None, port: int | None = None,
        **about: Any,
    ) -> None:  # fmt: skip
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
        hello = {"version": VERSION, "run": run, "channel": channel, "endpoint": endpoint, "notice": notice, **about}
        self._hello = json.dumps(hello).encode()
        self._port = port
        self._clients: list[Client] = []
        self._departed: list[Client] = []  # gone, but what they sent has not gone to the bus yet
        self._now_ns = 0
        self._turn = 0
        self._state = ControllerState(0, 0, 0)
        self.overruns = 0  # frames that a slow client missed
        self.malformed = 0
        self.first_sender: int | None = None  # process whose frame was the first

    @property
    def clients(self) -> int:
        return len(self._clients)

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
                self._listen_to(client, now_ns)
            if client.backlog or client.flying or client.tasks or client.untold:
                self._serve(client, now_ns, frames)
            if client.state is not self._state and not client.left and self._send(client, pack_state(self._state)):
                client.state = self._state
        if self._departed:
            self._departed = [client for client in self._departed if client.backlog or client.flying]
        return frames

    def _admit(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                connection, _ = self._listener.accept()
                pid, uid = peer(connection)
                if uid != os.getuid() or len(self._clients) + len(self._departed) >= _MAX_CLIENTS:
                    connection.close()
                    continue
                connection.setblocking(False)
                with contextlib.suppress(OSError):
                    connection.send(self._hello)
                self._clients.append(Client(connection, pid))

    def _listen_to(self, client: Client, now_ns: int) -> None:
        for _ in range(_MAX_RECORDS):  # a client that floods must not stop the run
            try:
                record = client.connection.recv(LARGEST + 1)
            except BlockingIOError:
                return
            except ConnectionResetError:  # it left with messages unread; what it has sent follows
                continue
            except OSError:
                record = b""
            if not record:
                self._drop(client)
                return
            try:
                self._heed(client, record, now_ns)
            except MalformedRecordError:
                self.malformed += 1

    def _heed(self, client: Client, record: bytes, now_ns: int) -> None:
        kind, tag = kind_and_tag(record)
        if kind == FRAME:
            frame = unpack_frame(record)[2]
            if len(client.backlog) >= WINDOW + IN_FLIGHT:  # periodic frames may have come back to it
                raise MalformedRecordError("more frames than the window allows")
            client.backlog.append((tag, frame))
            if self.first_sender is None:
                self.first_sender = client.pid
        elif kind == PERIODIC:
            period_ns, duration_ns, frames = unpack_task(record)
            task = client.tasks.get(tag)
            if period_ns == 0:
                if task is not None:
                    task.exchange(frames)
            elif task is None and len(client.tasks) >= _MAX_TASKS:
                raise MalformedRecordError("too many periodic tasks")
            else:
                client.tasks[tag] = Task(now_ns, period_ns, duration_ns, frames)
                if self.first_sender is None:
                    self.first_sender = client.pid
        elif kind == STOP:
            client.tasks.pop(tag, None)
        elif kind == FLUSH:
            for discarded, _ in client.backlog:
                self._tell_fate(client, FLUSHED, discarded)
            client.backlog.clear()
        else:
            raise MalformedRecordError(f"a client does not send records of kind {kind}")

    def _serve(self, client: Client, now_ns: int, frames: list[Frame]) -> None:
        """Append what may go to the bus now to ``frames``."""
        flying, backlog = client.flying, client.backlog
        while flying and flying[0][2] <= now_ns - _UNSEEN_NS:
            self._tell_fate(client, UNSEEN, flying.popleft()[0])
        for number, task in list(client.tasks.items()):
            for frame in task.due(now_ns)[: IN_FLIGHT - len(flying)]:  # what finds no place was due in vain
                flying.append((0, frame, now_ns))
                frames.append(frame)
            if task.finished:
                del client.tasks[number]
        while backlog and len(flying) < IN_FLIGHT:
            tag, frame = backlog.popleft()
            flying.append((tag, frame, now_ns))
            frames.append(frame)
        while client.untold and self._send(client, client.untold[0]):
            client.untold.popleft()

    def refused(self, frame: Frame) -> None:
        """The transmit queue was full when ``frame``, of the last ``poll``, was offered: it is offered again later."""
        for client in (*self._clients, *self._departed):
            for n in range(len(client.flying) - 1, -1, -1):
                tag, sent, _ = client.flying[n]
                if sent == frame:
                    del client.flying[n]
                    client.backlog.appendleft((tag, frame))
                    return

    def broadcast(self, time_ns: int, sender: int, frame: Frame) -> None:
        """Send ``frame`` to all clients; one that does not keep up misses it. A client that has sent this
        frame is told that it is its own."""
        if not (self._clients or self._departed):
            return
        self._now_ns = time_ns
        origin, tag = self._origin(frame) if self._port is None or sender == self._port else (None, 0)
        record = pack_frame(frame, time_ns, sender)
        for client in tuple(self._clients):
            if client is not origin:
                self._tell(client, record)
            else:
                own = pack_frame(frame, time_ns, sender, OWN, tag)
                if client.untold or not self._send(client, own):
                    client.untold.append(own)

    def broadcast_error(self, time_ns: int, error: ErrorFrame, sender: int = 0) -> None:
        """Send an error frame to all clients."""
        record = pack_error(error, time_ns, sender)
        for client in tuple(self._clients):
            self._tell(client, record)

    def set_state(self, tec: int, rec: int, state: int) -> None:
        """Error counters of the clients' controller, and whether it is error active (0), error passive (1) or off
        the bus (2). Clients are told of a change at the next ``poll``."""
        new = ControllerState(tec, rec, state)
        if new != self._state:
            self._state = new

    def _origin(self, frame: Frame) -> tuple[Client | None, int]:
        for client in (*self._clients, *self._departed):
            for n, (tag, sent, _) in enumerate(client.flying):
                if sent == frame:
                    del client.flying[n]
                    return client, tag
        return None, 0

    def _tell(self, client: Client, record: bytes) -> None:
        if not self._send(client, record):
            self.overruns += 1

    def _tell_fate(self, client: Client, kind: int, tag: int) -> None:
        if tag:
            client.untold.append(pack_note(kind, tag, self._now_ns))

    def _send(self, client: Client, record: bytes) -> bool:
        try:
            client.connection.send(record)
        except BlockingIOError:
            return False
        except OSError:
            pass  # it has left; what it has sent is still to be read
        return True

    def _drop(self, client: Client) -> None:
        client.left = True
        client.tasks.clear()
        client.untold.clear()
        client.connection.close()
        self._clients.remove(client)
        self._departed.append(client)

    def close(self) -> None:
        for client in self._clients:
            client.connection.close()
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
    """Attach to ``channel`` ("left_leg", or "RUN/left_leg" when several runs go on). Returns socket and
    hello; with ``ask_only`` also that of a bus which takes no more clients.

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
