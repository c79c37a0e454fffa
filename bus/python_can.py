"""python-can interface ``hil``: a port on an emulated bus, ``can.Bus(interface="hil", channel="left_leg")``.

Timestamps are bus time in seconds. Waiting (``recv(timeout)``) is by the clock on the wall, as everywhere in
python-can, whatever the speed of the run. What a program sends into a run makes that run differ from its scenario:
it is no longer reproducible from the scenario alone, and the program's log says so once.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import can
from can.broadcastmanager import (
    CyclicSendTaskABC,
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from bus.can_messages import to_error_message, to_frame, to_message
from bus.frames import Frame
from bus.ports import WINDOW, PortError, connect, served
from bus.records import (
    ERROR,
    FLUSH,
    FLUSHED,
    FRAME,
    OWN,
    RECORD_SIZE,
    STATE,
    STOP,
    TASK_FRAMES,
    UNSEEN,
    ControllerState,
    MalformedRecordError,
    kind_and_tag,
    pack_frame,
    pack_note,
    pack_task,
    unpack_error,
    unpack_frame,
    unpack_state,
)
from bus.shm_port import ShmPort

_log = logging.getLogger("can.hil")
_ENDED = "the emulation has ended"
_INBOX = 10_000  # messages that wait to be received; the oldest give way
_FATES = {
    UNSEEN: "the frame was not on the bus within a second of bus time: it is lost, or others keep it waiting",
    FLUSHED: "the frame was discarded by flush_tx_buffer",
}
_STATES = (can.BusState.ACTIVE, can.BusState.PASSIVE, can.BusState.ERROR)


class Transmission(Future[float]):
    """What becomes of a frame: ``result(timeout)`` is the bus time (s) at which it had been on the bus.

    ``result`` reads from the port while it waits. Waiting in another way (``asyncio.wrap_future``) needs somebody
    who does: a can.Notifier, or a thread in ``recv``.
    """

    def __init__(self, bus: HilBus) -> None:
        super().__init__()
        self.set_running_or_notify_cancel()  # it cannot be called back
        self._bus = bus

    def result(self, timeout: float | None = None) -> float:
        """Raises can.CanOperationError when it did not get there, can.CanTimeoutError when that is not known yet."""
        if not self._bus._wait_for(self.done, timeout):
            raise can.CanTimeoutError(f"the frame was not on the bus within {timeout} s")
        return super().result(0)


class BusTimeTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Periodic sending with period and duration in bus time, done by the bus's side.

    In a run in virtual time, messages come every ``period`` of the run's time however fast it goes, each when the
    bus is next looked after (in a run at every tick of the controller), and without drift. Messages that find the
    transmit queue full are left out.
    """

    def __init__(
        self, bus: HilBus, tag: int, messages: Sequence[can.Message], period: float, duration: float | None
    ) -> None:
        super().__init__(messages, period, duration)
        if self.period_ns < 1:
            raise ValueError(f"period {period} s: expected at least 1 ns")
        if len(self.messages) > TASK_FRAMES:
            raise ValueError(f"{len(self.messages)} messages: a periodic task takes at most {TASK_FRAMES}")
        self._bus, self._tag = bus, tag

    def _frames(self) -> list[Frame]:
        return [to_frame(message) for message in self.messages]

    def start(self) -> None:
        duration_ns = -1 if self.duration is None else round(self.duration * 1e9)
        self._bus._order(pack_task(self._tag, self.period_ns, duration_ns, self._frames()))

    def stop(self) -> None:
        with contextlib.suppress(can.CanOperationError):  # nothing goes on when the emulation has ended
            self._bus._order(pack_note(STOP, self._tag))

    def modify_data(self, messages: Sequence[can.Message] | can.Message) -> None:
        super().modify_data(messages)
        self._bus._order(pack_task(self._tag, 0, 0, self._frames()))


class HilBus(can.BusABC):
    """A port on an emulated bus.

    Args:
        channel: name of the bus ("left_leg"), or "RUN/left_leg" when several runs go on.
        receive_own_messages: also receive what this port sent, once it has been on the bus.
        ignore_rx_error_frames: do not receive error frames. Filters never apply to them, as with SocketCAN.
        port: a port in shared memory; only the emulation itself has one to give. There, time stands still
            while a node runs: ``recv`` never waits, and timestamps are 0.
        kwargs: as of can.BusABC (``can_filters``).

    Raises can.CanInitializationError when no run serves ``channel``, and can.CanInterfaceNotImplementedError
    where there are no abstract Unix sockets.
    """

    recv_frames: Any  # of a port in shared memory: the frames that wait, without python-can's objects
    send_frame: Any

    def __init__(
        self,
        channel: str = "",
        *,
        receive_own_messages: bool = False,
        ignore_rx_error_frames: bool = False,
        port: ShmPort | None = None,
        **kwargs: Any,
    ) -> None:
        self._port = port
        self._socket: socket.socket | None = None
        self._receive_own = receive_own_messages
        self._ignore_errors = ignore_rx_error_frames
        self._can_protocol = can.CanProtocol.CAN_FD
        self.channel = channel = str(channel)
        self._inbox: deque[can.Message] = deque(maxlen=_INBOX)
        self._controller = ControllerState(0, 0, 0)
        self._listen_only = False
        self.malformed = 0  # records that were none
        self.overruns = 0  # messages lost because nobody received them
        if port is not None:
            self.channel_info = f"hil {channel} (shared memory)"
            self.recv_frames = port.recv_frames
            self.send_frame = port.send_frame
            super().__init__(channel=channel, **kwargs)
            self._is_shutdown = True  # the memory is its owner's: nothing to shut down
            return
        if sys.platform != "linux":
            raise can.CanInterfaceNotImplementedError("the hil interface needs Linux (abstract Unix sockets)")
        self._reader = threading.Lock()  # held by the thread that reads from the socket
        self._changed = threading.Condition()  # the others wait here for what it finds; guards what is counted below
        self._waiters = 0
        self._ended = False
        self._outstanding = 0  # frames sent of which it is not known what became of them
        self._transmissions: dict[int, Transmission] = {}
        self._tags = itertools.count(1)
        self._signalled = False
        try:
            self._socket, hello = connect(channel)
        except PortError as error:
            raise can.CanInitializationError(str(error)) from None
        self._socket.settimeout(None)
        self._notice: str | None = hello.get("notice")
        if not hello.get("fd", True):
            self._can_protocol = can.CanProtocol.CAN_20
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        # Readable with the socket, and with messages that were read while something else was waited for.
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._either = select.epoll()
        self._either.register(self._socket, select.EPOLLIN)
        self._either.register(self._bell, select.EPOLLIN)
        self.channel_info = f"hil {hello['run']}/{hello['channel']}"
        try:
            super().__init__(channel=channel, **kwargs)
        except Exception:
            self._close()
            raise

    # --- sending ------------------------------------------------------------------------------------------------

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the bus.

        Without ``timeout`` it returns when the transmit buffer has taken the frame, waiting for a place if need be;
        with 0 it does not wait for a place. With more, it returns when the frame *has been on the bus*.

        Raises can.CanOperationError for a frame that the bus does not carry, when the frame did not get onto the
        bus, or when the emulation has ended; can.CanTimeoutError when ``timeout`` is over.
        """
        frame = to_frame(msg)
        if self._port is not None:
            if not self._port.send_frame(frame):
                raise can.CanOperationError("the transmit buffer is full")
            return
        if not timeout:
            self._transmit(frame, timeout, None)
            return
        deadline = time.monotonic() + timeout
        transmission = Transmission(self)
        self._transmit(frame, timeout, transmission)
        transmission.result(max(deadline - time.monotonic(), 0.0))

    def transmit(self, msg: can.Message, timeout: float | None = None) -> Transmission:
        """As ``send`` without a timeout, and tells later what became of the frame.

        ``timeout`` limits the wait for a place in the transmit buffer. Raises as ``send`` does.
        """
        if self._port is not None:
            raise can.CanOperationError("a port in shared memory does not tell what becomes of a frame")
        transmission = Transmission(self)
        self._transmit(to_frame(msg), timeout, transmission)
        return transmission

    def _transmit(self, frame: Frame, timeout: float | None, transmission: Transmission | None) -> None:
        if self._listen_only:
            raise can.CanOperationError("this port only listens: set state to BusState.ACTIVE")
        if frame.fd and self._can_protocol is can.CanProtocol.CAN_20:
            raise can.CanOperationError("a classical bus does not carry CAN FD frames")
        if self._notice is not None:
            _log.warning("%s: %s", self.channel_info, self._notice)
            self._notice = None
        while True:
            with self._changed:
                self._check()
                if self._outstanding < WINDOW:
                    self._outstanding += 1
                    tag = next(self._tags) & 0xFFFFFFFF or next(self._tags) & 0xFFFFFFFF
                    if transmission is not None:
                        self._transmissions[tag] = transmission
                    break
            if not self._wait_for(lambda: self._outstanding < WINDOW, timeout):
                raise can.CanTimeoutError("the transmit buffer is full")
        self._order(pack_frame(frame, tag=tag))

    def _order(self, record: bytes) -> None:
        self._check()
        assert self._socket is not None
        try:
            self._socket.send(record)
        except OSError as error:
            raise can.CanOperationError(f"{_ENDED} ({error})") from None

    def flush_tx_buffer(self) -> None:
        """Discard what has not gone to the bus yet, but for the few frames that the controller has already."""
        if self._port is None:
            self._order(pack_note(FLUSH))

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> CyclicSendTaskABC:
        """Periods are of bus time (``BusTimeTask``); but with a ``modifier_callback``, which must be called for each
        message, it is python-can's thread that sends, by the clock on the wall."""
        if self._port is not None or modifier_callback is not None:
            return super()._send_periodic_internal(msgs, period, duration, autostart, modifier_callback)
        messages = [msgs] if isinstance(msgs, can.Message) else msgs
        task = BusTimeTask(self, next(self._tags) & 0xFFFFFFFF, messages, period, duration)
        if autostart:
            task.start()
        return task

    # --- receiving ----------------------------------------------------------------------------------------------

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message that the filters let pass, None when there is none within ``timeout`` seconds.

        Raises can.CanOperationError when the emulation has ended.
        """
        if self._port is None:
            return super().recv(timeout)
        self._inbox.extend(to_message(frame, 0, self.channel) for frame in self._port.recv_frames())
        while self._inbox:
            message = self._inbox.popleft()
            if self._matches_filters(message):
                return message
        return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        inbox = self._inbox
        if not inbox:
            self._wait(inbox.__len__, timeout)
        try:
            message = inbox.popleft()
        except IndexError:  # nothing came, or another thread has taken it
            return None, False
        if inbox or self._signalled:
            self._signal()
        return message, message.is_error_frame

    def _wait_for(self, condition: Callable[[], Any], timeout: float | None) -> bool:
        """``_wait`` for something else than a message: those that came meanwhile are made known."""
        try:
            return self._wait(condition, timeout)
        finally:
            self._signal()

    def _wait(self, condition: Callable[[], Any], timeout: float | None) -> bool:
        """Read from the socket until ``condition``, at most ``timeout`` seconds; whether it holds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        left = timeout
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
            self._check()
            assert self._socket is not None
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
                self._keep(to_message(frame, time_ns, self.channel))
            elif kind == OWN:
                time_ns, _, frame = unpack_frame(record)
                if self._receive_own:
                    self._keep(to_message(frame, time_ns, self.channel, own=True))
                if tag and (transmission := self._settle(tag)) is not None:
                    transmission.set_result(time_ns / 1e9)
            elif kind == ERROR:
                time_ns, error = unpack_error(record)
                if not self._ignore_errors:
                    self._keep(to_error_message(error, time_ns, self.channel))
            elif kind == STATE:
                self._controller = unpack_state(record)
            elif kind in _FATES:
                if (transmission := self._settle(tag)) is not None:
                    transmission.set_exception(can.CanOperationError(_FATES[kind]))
            else:
                self.malformed += 1
        except MalformedRecordError:
            self.malformed += 1

    def _keep(self, message: can.Message) -> None:
        self.overruns += len(self._inbox) == _INBOX
        self._inbox.append(message)

    def _settle(self, tag: int) -> Transmission | None:
        with self._changed:
            self._outstanding -= 1
        return self._transmissions.pop(tag, None)

    def _end(self) -> None:
        self._ended = True
        with contextlib.suppress(OSError, ValueError):
            self._either.unregister(self._socket.fileno())  # type: ignore[union-attr]  # it would be readable for ever
        for transmission in self._transmissions.values():
            transmission.set_exception(can.CanOperationError(_ENDED))
        self._transmissions.clear()

    def _check(self) -> None:
        if self._socket is None or self._socket.fileno() < 0:
            raise can.CanOperationError("this port is shut down")
        if self._ended:
            raise can.CanOperationError(_ENDED)

    def _signal(self) -> None:
        """Let ``fileno`` be readable if and only if messages wait here."""
        with self._changed:
            if self._signalled == bool(self._inbox) or self._either.closed:
                return
            self._signalled = not self._signalled
            if self._signalled:
                os.eventfd_write(self._bell, 1)
            else:
                os.eventfd_read(self._bell)

    # --- state --------------------------------------------------------------------------------------------------

    def _controller_now(self) -> ControllerState:
        if self._port is None:
            while not self._ended and self._pump(0.0):
                pass
            self._signal()
        return self._controller

    @property
    def state(self) -> can.BusState:
        """Error active, error passive or (bus off) in error: of the controller that all programs on this bus share.

        May be set to PASSIVE: this port then only listens, until it is set to ACTIVE.
        """
        state = _STATES[min(self._controller_now().state, 2)]
        return can.BusState.PASSIVE if self._listen_only and state is can.BusState.ACTIVE else state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is can.BusState.ERROR:
            raise ValueError("state: expected BusState.ACTIVE, or BusState.PASSIVE to only listen")
        self._listen_only = new_state is can.BusState.PASSIVE

    @property
    def error_counters(self) -> tuple[int, int]:
        """Transmit and receive error counter of the controller that all programs on this bus share."""
        return self._controller_now()[:2]

    def fileno(self) -> int:
        """Descriptor that becomes readable with a message; -1 for a port in shared memory or one shut down."""
        return -1 if self._socket is None or self._either.closed else self._either.fileno()

    def shutdown(self) -> None:
        """Detach. What was sent still goes to the bus."""
        super().shutdown()
        if self._socket is not None:
            self._close()

    def _close(self) -> None:
        assert self._socket is not None
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

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        return [{"interface": "hil", "channel": f"{run}/{channel}"} for run, channel in served()]
