"""A program that is attached to an emulated bus, seen from the bus: what it sends, and what it is told."""

from __future__ import annotations

import socket
import struct
from collections import deque

from bus.frames import Frame
from bus.link import NEVER
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
    ControllerState,
    MalformedRecordError,
    kind_and_tag,
    pack_frame,
    pack_note,
    pack_state,
    unpack_frame,
    unpack_task,
)

WINDOW = 64  # frames of a client whose fate it does not know
IN_FLIGHT = 16  # frames of a client that wait in the controller
UNSEEN_NS = 1_000_000_000  # bus time after which a frame that was not on the bus is given up
_RETRY_NS = 1_000_000  # for a full socket
_MAX_TASKS = 64
_MAX_RECORDS = 2 * WINDOW  # that it is heard for at a time


def peer(connection: socket.socket) -> tuple[int, int]:
    """Process and user at the other end, as the kernel knows them."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, _ = struct.unpack("3i", credentials)
    return pid, uid


class Client:
    """One attached socket. It hands over at most ``WINDOW`` frames whose fate it does not know, and at most
    ``IN_FLIGHT`` of them wait in the bus controller; it always learns what became of each.

    ``hear`` and then ``due`` whenever the bus is looked after; ``landed`` when a frame has been on the bus.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.socket = connection
        self.pid = peer(connection)[0]
        self.left = False  # it has gone; what it has sent before may still be due
        self.sent = 0  # frames taken from it
        self.received = 0  # records that it was given
        self.missed = 0  # records that it was too slow for
        self.malformed = 0  # what it has sent and was no record
        self._backlog: deque[tuple[int, Frame]] = deque()  # tag and frame, not yet handed to the bus
        self._flying: deque[tuple[int, Frame, int]] = deque()  # handed to the bus at that time, not yet seen on it
        self._untold: deque[bytes] = deque()  # about its own frames, not yet taken by its socket
        self._tasks: dict[int, Task] = {}
        self._state: ControllerState | None = None  # as it was told
        self._asked_ns = 0

    @property
    def idle(self) -> bool:
        """Nothing that it has sent is left to do."""
        return not (self._backlog or self._flying or self._tasks or self._untold)

    def next_ns(self) -> int:
        """Bus time at which ``due`` should be asked again even if nothing happens until then; NEVER if not."""
        times = [task.next_ns for task in self._tasks.values()]
        if self._flying:
            times.append(self._flying[0][2] + UNSEEN_NS)
        if self._untold:
            times.append(self._asked_ns + _RETRY_NS)
        return min(times, default=NEVER)

    def hear(self, now_ns: int) -> None:
        """Take what it has sent. Never blocks; ``left`` is set when it has gone."""
        for _ in range(_MAX_RECORDS):  # one that floods must not stop the bus
            try:
                record = self.socket.recv(LARGEST + 1)
            except BlockingIOError:
                return
            except ConnectionResetError:  # it left with messages unread; what it has sent follows
                continue
            except OSError:
                record = b""
            if not record:
                self.close()
                return
            try:
                self._heed(record, now_ns)
            except MalformedRecordError:
                self.malformed += 1

    def _heed(self, record: bytes, now_ns: int) -> None:
        kind, tag = kind_and_tag(record)
        if kind == FRAME:
            frame = unpack_frame(record)[2]
            if len(self._backlog) >= WINDOW + IN_FLIGHT:  # periodic frames may have come back to it
                raise MalformedRecordError("more frames than the window allows")
            self._backlog.append((tag, frame))
            self.sent += 1
        elif kind == PERIODIC:
            self._heed_periodic(record, tag, now_ns)
        elif kind == STOP:
            self._tasks.pop(tag, None)
        elif kind == FLUSH:
            for discarded, _ in self._backlog:
                self._tell_fate(FLUSHED, discarded, now_ns)
            self._backlog.clear()
        else:
            raise MalformedRecordError(f"a client does not send records of kind {kind}")

    def _heed_periodic(self, record: bytes, tag: int, now_ns: int) -> None:
        period_ns, duration_ns, frames = unpack_task(record)
        task = self._tasks.get(tag)
        if period_ns == 0:
            if task is not None:
                task.exchange(frames)
        elif task is None and len(self._tasks) >= _MAX_TASKS:
            raise MalformedRecordError("too many periodic tasks")
        else:
            self._tasks[tag] = Task(now_ns, period_ns, duration_ns, frames)

    def due(self, now_ns: int) -> list[Frame]:
        """The frames that are to be offered to the bus now."""
        self._asked_ns = now_ns
        flying, backlog, frames = self._flying, self._backlog, []
        self._tell_unseen(now_ns)
        for number, task in list(self._tasks.items()):
            for frame in task.due(now_ns)[: max(IN_FLIGHT - len(flying), 0)]:  # without a place it was due in vain
                flying.append((0, frame, now_ns))
                frames.append(frame)
            if task.finished:
                del self._tasks[number]
        while backlog and len(flying) < IN_FLIGHT:
            tag, frame = backlog.popleft()
            flying.append((tag, frame, now_ns))
            frames.append(frame)
        while self._untold and self._send(self._untold[0]):
            self._untold.popleft()
        return frames

    def _tell_unseen(self, now_ns: int) -> None:
        """Give up frames that have been under way for too long."""
        while self._flying and self._flying[0][2] <= now_ns - UNSEEN_NS:
            self._tell_fate(UNSEEN, self._flying.popleft()[0], now_ns)

    def refused(self, frame: Frame) -> bool:
        """The transmit queue was full when ``frame``, which was due, was offered: it will be due again. False when it
        is none of this client's."""
        flying = self._flying
        for n in range(len(flying) - 1, -1, -1):
            tag, sent, _ = flying[n]
            if sent == frame:
                del flying[n]
                self._backlog.appendleft((tag, frame))
                return True
        return False

    def landed(self, time_ns: int, sender: int, frame: Frame) -> bool:
        """``frame`` has been on the bus: if it is this client's, it is told so, and the answer is True."""
        for n, (tag, sent, _) in enumerate(self._flying):
            if sent == frame:
                del self._flying[n]
                own = pack_frame(frame, time_ns, sender, OWN, tag)
                if self._untold or not self._send(own):
                    self._untold.append(own)
                return True
        return False

    def give(self, record: bytes) -> None:
        """Send it a record, which it misses when it does not keep up."""
        if not self._send(record):
            self.missed += 1

    def tell_state(self, state: ControllerState) -> None:
        """Of its controller, when that has changed."""
        if self._state != state and self._send(pack_state(state)):
            self._state = state

    def _tell_fate(self, kind: int, tag: int, now_ns: int) -> None:
        if tag:
            self._untold.append(pack_note(kind, tag, now_ns))

    def _send(self, record: bytes) -> bool:
        try:
            self.socket.send(record)
            self.received += 1
        except BlockingIOError:
            return False
        except OSError:
            pass  # it has left; what it has sent is still to be read
        return True

    def close(self) -> None:
        """Hang up; frames that it has sent stay due."""
        self.left = True
        self._tasks.clear()
        self._untold.clear()
        self.socket.close()
