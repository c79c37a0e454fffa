"""Ports on an emulated bus: shared memory for a firmware process, a Unix socket for any other process.

A record on the socket, little-endian: time i64 (ns), identifier u32, flags u8, sender u8, length u8, own u8
(1 in what a client is told of a frame that it sent itself), data. A slot of a ring: identifier u32, flags
u8, length u8, two bytes unused, 64 bytes of data.
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

from bus.frames import Frame, is_valid

_RECORD = struct.Struct("<qIBBBB")
RECORD_SIZE = _RECORD.size + 64
_FD, _BRS, _EXTENDED = 1, 2, 4
VERSION = 1
_BACKLOG = 16
_PREFIX = "hume-hil"


class PortError(RuntimeError):
    """A port cannot be opened or reached."""


class MalformedRecordError(ValueError):
    """Bytes that are not a frame."""


def pack_frame(frame: Frame, time_ns: int = 0, sender: int = 0, own: bool = False) -> bytes:
    """The record of ``frame``."""
    identifier, data, fd, brs, extended, _, _ = frame
    flags = (_FD if fd else 0) | (_BRS if brs else 0) | (_EXTENDED if extended else 0)
    return _RECORD.pack(time_ns, identifier, flags, sender, len(data), own) + data


def is_own(record: bytes) -> bool:
    """Whether the client that receives this record is the one that sent the frame."""
    return record[_RECORD.size - 1] == 1


def unpack_frame(record: bytes) -> tuple[int, int, Frame]:
    """Time in ns, sender and frame of a record. Raises MalformedRecordError."""
    if len(record) < _RECORD.size:
        raise MalformedRecordError(f"a record of {len(record)} bytes")
    time_ns, identifier, flags, sender, length, own = _RECORD.unpack_from(record)
    fd, brs, extended = bool(flags & _FD), bool(flags & _BRS), bool(flags & _EXTENDED)
    if own > 1 or flags > 7 or len(record) != _RECORD.size + length:
        raise MalformedRecordError("flags or length do not fit")
    if not is_valid(identifier, length, fd, brs, extended):
        raise MalformedRecordError(f"no controller could send identifier {identifier:#x} with {length} bytes")
    return time_ns, sender, Frame(identifier, record[_RECORD.size :], fd, brs, extended)


# --- shared memory ------------------------------------------------------------------------------------------

_SLOTS = 32  # frames that can wait in one direction
_SLOT = struct.Struct("<IBB2x64s")
_SLOT_SIZE = _SLOT.size
_FLAGS = tuple((bool(f & _FD), bool(f & _BRS), bool(f & _EXTENDED)) for f in range(256))


class _Ring:
    """Single producer, single consumer. The lockstep hands over by eventfd, which orders the memory and lets
    only one side run at a time: no locks."""

    SIZE = 16 + _SLOTS * _SLOT_SIZE

    def __init__(self, memory: memoryview) -> None:
        self._ends = memory[:16].cast("q")  # written, read
        self._slots = memory[16 : self.SIZE]
        self.overruns = 0
        self.malformed = 0  # slots that hold no frame

    def put(self, frame: Frame) -> bool:
        """Append ``frame``; False when the ring is full, as a controller's buffer would overrun."""
        ends = self._ends
        if ends[0] - ends[1] >= _SLOTS:
            self.overruns += 1
            return False
        written = ends[0]
        identifier, data, fd, brs, extended, _, _ = frame
        flags = (_FD if fd else 0) | (_BRS if brs else 0) | (_EXTENDED if extended else 0)
        _SLOT.pack_into(self._slots, written % _SLOTS * _SLOT_SIZE, identifier, flags, len(data), data)
        ends[0] = written + 1
        return True

    def take(self) -> list[Frame]:
        """All frames that wait, oldest first; what no controller could send is dropped and counted."""
        ends = self._ends
        written, read = ends[0], ends[1]
        if written == read:
            return []
        frames: list[Frame] = []
        ends[1] = written
        if not 0 < written - read <= _SLOTS:
            self.malformed += 1
            return frames
        for n in range(read, written):
            identifier, flags, length, data = _SLOT.unpack_from(self._slots, n % _SLOTS * _SLOT_SIZE)
            fd, brs, extended = _FLAGS[flags]
            if flags < 8 and is_valid(identifier, length, fd, brs, extended):
                frames.append(Frame(identifier, data[:length], fd, brs, extended))
            else:
                self.malformed += 1
        return frames


class ShmPort:
    """A port in ``SIZE`` bytes of shared memory; ``firmware=True`` is the mirror image for the firmware."""

    SIZE = 2 * _Ring.SIZE

    def __init__(self, memory: memoryview, firmware: bool = False) -> None:
        down, up = _Ring(memory[: _Ring.SIZE]), _Ring(memory[_Ring.SIZE : self.SIZE])
        self._outgoing, self._incoming = (up, down) if firmware else (down, up)

    def send_frame(self, frame: Frame) -> bool:
        """Hand ``frame`` to the other side; False when it does not take any more."""
        return self._outgoing.put(frame)

    def recv_frames(self) -> list[Frame]:
        """Frames from the other side."""
        return self._incoming.take()

    @property
    def malformed(self) -> int:
        """What came from the other side and was no frame."""
        return self._incoming.malformed


# --- sockets ------------------------------------------------------------------------------------------------


def _address(run: str, channel: str) -> str:
    return f"\0{_PREFIX}/{os.getuid()}/{run}/{channel}"


def peer(connection: socket.socket) -> tuple[int, int]:
    """Process and user id of the other side, as the kernel knows them."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return struct.unpack("3i", credentials)[:2]


def _peer_uid(connection: socket.socket) -> int:
    return peer(connection)[1]


class PortServer:
    """Serves one bus to other processes of the same user, at an abstract address that dies with this process.

    A client that does not keep up misses frames (``overruns``); what is not a frame is dropped
    (``malformed``).
    """

    def __init__(self, channel: str, run: str, endpoint: str | None = None, **about: Any) -> None:
        """``about``: what else a client is told when it attaches."""
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
        self._clients: list[socket.socket] = []
        # what clients sent and the bus has not yet shown
        self._sent: deque[tuple[socket.socket, Frame]] = deque(maxlen=256)
        self.overruns = 0  # frames that a slow client missed
        self.malformed = 0

    @property
    def clients(self) -> int:
        return len(self._clients)

    def poll(self) -> list[Frame]:
        """Let new clients in; return the frames that clients sent. Never blocks."""
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                client, _ = self._listener.accept()
                if _peer_uid(client) != os.getuid():
                    client.close()
                    continue
                client.setblocking(False)
                with contextlib.suppress(OSError):
                    client.send(self._hello)
                self._clients.append(client)
        frames: list[Frame] = []
        for client in list(self._clients):
            for _ in range(64):  # a client that floods must not stop the run
                try:
                    record = client.recv(RECORD_SIZE + 1)
                except BlockingIOError:
                    break
                except OSError:
                    record = b""
                if not record:
                    self._drop(client)
                    break
                try:
                    frame = unpack_frame(record)[2]
                except MalformedRecordError:
                    self.malformed += 1
                    continue
                frames.append(frame)
                self._sent.append((client, frame))
        return frames

    def broadcast(self, time_ns: int, sender: int, frame: Frame) -> None:
        """Send ``frame`` to all clients; one that does not keep up misses it. A client that has sent this
        frame is told that it is its own."""
        if not self._clients:
            return
        origin = self._origin(frame) if self._sent else None
        record = pack_frame(frame, time_ns, sender)
        for client in list(self._clients):
            try:
                client.send(record if client is not origin else pack_frame(frame, time_ns, sender, own=True))
            except BlockingIOError:
                self.overruns += 1
            except OSError:
                self._drop(client)

    def _origin(self, frame: Frame) -> socket.socket | None:
        for n, (client, sent) in enumerate(self._sent):
            if sent == frame:
                del self._sent[n]
                return client
        return None

    def _drop(self, client: socket.socket) -> None:
        self._clients.remove(client)
        client.close()

    def close(self) -> None:
        for client in self._clients:
            client.close()
        self._clients.clear()
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
        if _peer_uid(connection) != os.getuid():
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
