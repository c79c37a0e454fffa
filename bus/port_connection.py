"""The program's end of a port on an emulated bus: sorts what comes from the socket, for any number of threads."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import can

from bus.can_messages import to_error_message, to_message
from bus.frames import Frame
from bus.port_client import WINDOW
from bus.ports import connect
from bus.records import (
    ERROR,
    FLUSHED,
    FRAME,
    OWN,
    RECORD_SIZE,
    STATE,
    UNSEEN,
    ControllerState,
    MalformedRecordError,
    kind_and_tag,
    pack_frame,
    unpack_error,
    unpack_frame,
    unpack_state,
)

_ENDED = "the emulation has ended"
_INBOX = 10_000  # messages that wait to be received; the oldest give way
_FATES = {
    UNSEEN: "the frame was not on the bus within a second of bus time: it is lost, or others keep it waiting",
    FLUSHED: "the frame was discarded by flush_tx_buffer",
}


class Transmission(Future[float]):
    """What becomes of a frame: ``result(timeout)`` is the bus time (s) at which it had been on the bus.

    ``result`` reads from the port while it waits. Waiting in another way (``asyncio.wrap_future``) needs somebody
    who does: a can.Notifier, or a thread in ``recv``.
    """

    def __init__(self, connection: PortConnection) -> None:
        super().__init__()
        self.set_running_or_notify_cancel()  # it cannot be called back
        self._connection = connection

    def result(self, timeout: float | None = None) -> float:
        """Raises can.CanOperationError when it did not get there, can.CanTimeoutError when that is not known yet."""
        if not self._connection.wait_for(self.done, timeout):
            raise can.CanTimeoutError(f"the frame was not on the bus within {timeout} s")
        return super().result(0)


class PortConnection:
    """A port on ``channel``. Threads share one reader: whoever waits first reads, for all.

    Args:
        channel: as of ``bus.ports.connect``.
        name: channel of the messages.
        receive_own: keep messages that were sent here, once they have been on the bus.
        ignore_errors: drop error frames.

    Raises bus.ports.PortError; every method raises can.CanOperationError when the emulation has ended.
    """

    def __init__(self, channel: str, name: str, receive_own: bool, ignore_errors: bool) -> None:
        self._socket, self.hello = connect(channel)
        self._socket.settimeout(None)
        self._name, self._receive_own, self._ignore_errors = name, receive_own, ignore_errors
        self.inbox: deque[can.Message] = deque(maxlen=_INBOX)
        self.controller = ControllerState(0, 0, 0)
        self.malformed = 0  # records that were none
        self.overruns = 0  # messages lost because nobody received them
        self._reader = threading.Lock()  # held by the thread that reads from the socket
        self._changed = threading.Condition()  # the others wait here for what it finds; guards what is counted below
        self._waiters = 0
        self._ended = False
        self._outstanding = 0  # frames sent of which it is not known what became of them
        self._transmissions: dict[int, Transmission] = {}
        self._tags = itertools.count(1)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        # Readable with the socket, and with messages that were read while something else was waited for.
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._rung = False
        self._either = select.epoll()
        self._either.register(self._socket, select.EPOLLIN)
        self._either.register(self._bell, select.EPOLLIN)

    # --- sending ------------------------------------------------------------------------------------------------

    def transmit(self, frame: Frame, timeout: float | None, transmission: Transmission | None = None) -> None:
        """Hand over ``frame``, waiting at most ``timeout`` seconds for a place; raises can.CanTimeoutError."""
        while True:
            with self._changed:
                self.check()
                if self._outstanding < WINDOW:
                    self._outstanding += 1
                    tag = self.new_tag()
                    if transmission is not None:
                        self._transmissions[tag] = transmission
                    break
            if not self.wait_for(lambda: self._outstanding < WINDOW, timeout):
                raise can.CanTimeoutError("the transmit buffer is full")
        self.order(pack_frame(frame, tag=tag))

    def new_tag(self) -> int:
        """A number other than 0 that no other frame or task has for long."""
        return next(self._tags) & 0xFFFFFFFF or next(self._tags) & 0xFFFFFFFF

    def order(self, record: bytes) -> None:
        """Send a record as it is."""
        self.check()
        try:
            self._socket.send(record)
        except OSError as error:
            raise can.CanOperationError(f"{_ENDED} ({error})") from None

    # --- receiving ----------------------------------------------------------------------------------------------

    def receive(self, timeout: float | None) -> can.Message | None:
        """The next message, None when there is none within ``timeout`` seconds."""
        inbox = self.inbox
        if not inbox:
            self._wait(inbox.__len__, timeout)
        try:
            message = inbox.popleft()
        except IndexError:  # nothing came, or another thread has taken it
            return None
        if inbox or self._rung:
            self._ring()
        return message

    def drain(self) -> None:
        """Sort in all that has come by now."""
        for _ in range(_INBOX):  # a bus may be faster than this
            if self._ended or not self._pump(0.0):
                break
        self._ring()

    def wait_for(self, condition: Callable[[], Any], timeout: float | None) -> bool:
        """Read until ``condition``, at most ``timeout`` seconds; whether it holds. Messages that come meanwhile wait,
        and ``fileno`` is readable with them."""
        try:
            return self._wait(condition, timeout)
        finally:
            self._ring()

    def _wait(self, condition: Callable[[], Any], timeout: float | None) -> bool:
        """Read from the socket until ``condition``, at most ``timeout`` seconds; whether it holds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        left = None if timeout is None else max(timeout, 0.0)
        while not condition():
            if not self._pump(left) and left == 0.0:
                return bool(condition())
            if deadline is not None:
                left = max(deadline - time.monotonic(), 0.0)
        return True

    def _pump(self, timeout: float | None) -> bool:
        """Read one record, or wait for what another thread reads; False when ``timeout`` is over."""
        if not self._reader.acquire(blocking=False):
            return self._follow(timeout)
        try:
            self.check()
            record = b""  # as of one that has gone
            try:
                record = self._socket.recv(RECORD_SIZE + 1, socket.MSG_DONTWAIT)
            except BlockingIOError:
                if timeout == 0.0 or not self._readable.poll(None if timeout is None else math.ceil(timeout * 1000)):
                    return False
                with contextlib.suppress(OSError):
                    record = self._socket.recv(RECORD_SIZE + 1, socket.MSG_DONTWAIT)
            except OSError:
                pass
            self._take(record)
            return True
        finally:
            self._reader.release()
            if self._waiters:
                with self._changed:
                    self._changed.notify_all()

    def _follow(self, timeout: float | None) -> bool:
        """Wait until the thread that reads has read something or has stopped."""
        with self._changed:
            self._waiters += 1
            try:
                return not self._reader.locked() or self._changed.wait(timeout)
            finally:
                self._waiters -= 1

    def _take(self, record: bytes) -> None:
        """Sort in what came."""
        if not record:
            self._end()
            return
        try:
            kind, tag = kind_and_tag(record)
            if kind == FRAME:
                time_ns, _, frame = unpack_frame(record)
                self._keep(to_message(frame, time_ns, self._name))
            elif kind == OWN:
                if self._receive_own:
                    time_ns, _, frame = unpack_frame(record)
                    self._keep(to_message(frame, time_ns, self._name, own=True))
                if tag and (transmission := self._settle(tag)) is not None:
                    transmission.set_result(int.from_bytes(record[:8], "little", signed=True) / 1e9)
            elif kind == ERROR:
                time_ns, error = unpack_error(record)
                if not self._ignore_errors:
                    self._keep(to_error_message(error, time_ns, self._name))
            elif kind == STATE:
                self.controller = unpack_state(record)
            elif kind in _FATES:
                if (transmission := self._settle(tag)) is not None:
                    transmission.set_exception(can.CanOperationError(_FATES[kind]))
            else:
                self.malformed += 1
        except MalformedRecordError:
            self.malformed += 1

    def _keep(self, message: can.Message) -> None:
        self.overruns += len(self.inbox) == _INBOX
        self.inbox.append(message)

    def _settle(self, tag: int) -> Transmission | None:
        with self._changed:
            self._outstanding -= 1
        return self._transmissions.pop(tag, None)

    def _end(self) -> None:
        self._ended = True
        with contextlib.suppress(OSError, ValueError):
            self._either.unregister(self._socket.fileno())  # it would be readable for ever
        with contextlib.suppress(KeyError):
            while True:
                self._transmissions.popitem()[1].set_exception(can.CanOperationError(_ENDED))

    def check(self) -> None:
        """Raise can.CanOperationError unless the bus is there."""
        if self._socket.fileno() < 0:
            raise can.CanOperationError("this port is shut down")
        if self._ended:
            raise can.CanOperationError(_ENDED)

    def _ring(self) -> None:
        """Let ``fileno`` be readable if and only if messages wait here."""
        with self._changed:
            if self._rung == bool(self.inbox) or self._either.closed:
                return
            self._rung = not self._rung
            if self._rung:
                os.eventfd_write(self._bell, 1)
            else:
                os.eventfd_read(self._bell)

    def fileno(self) -> int:
        """Readable when a message may be there; -1 when closed."""
        return -1 if self._either.closed else self._either.fileno()

    def close(self) -> None:
        """Detach; a second call does nothing."""
        with self._changed:
            if self._either.closed:
                return
            self._end()
            self._either.close()
            os.close(self._bell)
            with contextlib.suppress(OSError):  # the other side has gone already
                self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that reads
            self._socket.close()
            self._changed.notify_all()
