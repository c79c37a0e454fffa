"""python-can interface ``hil``: a port on an emulated bus, ``can.Bus(interface="hil", channel="left_leg")``.

Timestamps are bus time in seconds. Waiting (``recv(timeout)``) is by the clock on the wall, as everywhere in
python-can, whatever the speed of the run. What a program sends into a run makes that run differ from its scenario:
it is no longer reproducible from the scenario alone, and the program's log says so once.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import can
from can.broadcastmanager import (
    CyclicSendTaskABC,
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from bus.can_messages import to_frame, to_message
from bus.frames import Frame
from bus.port_connection import PortConnection, Transmission
from bus.ports import PortError, served
from bus.records import FLUSH, STOP, TASK_FRAMES, ControllerState, pack_note, pack_task
from bus.shm_port import ShmPort

_log = logging.getLogger("can.hil")
_STATES = (can.BusState.ACTIVE, can.BusState.ACTIVE, can.BusState.PASSIVE, can.BusState.ERROR)  # by can_state


class BusTimeTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Periodic sending with period and duration in bus time, done by the bus's side.

    In a run in virtual time, messages come every ``period`` of the run's time however fast it goes, each when the
    bus is next looked after (in a run at every tick of the controller), and without drift. Messages that find the
    transmit queue full are left out.
    """

    def __init__(
        self, connection: PortConnection, messages: Sequence[can.Message], period: float, duration: float | None
    ) -> None:
        super().__init__(messages, period, duration)
        if self.period_ns < 1:
            raise ValueError(f"period {period} s: expected at least 1 ns")
        if len(self.messages) > TASK_FRAMES:
            raise ValueError(f"{len(self.messages)} messages: a periodic task takes at most {TASK_FRAMES}")
        self._connection, self._tag = connection, connection.new_tag()

    def _frames(self) -> list[Frame]:
        return [to_frame(message) for message in self.messages]

    def start(self) -> None:
        duration_ns = -1 if self.duration is None else round(self.duration * 1e9)
        self._connection.order(pack_task(self._tag, self.period_ns, duration_ns, self._frames()))

    def stop(self) -> None:
        with contextlib.suppress(can.CanOperationError):  # nothing goes on when the emulation has ended
            self._connection.order(pack_note(STOP, self._tag))

    def modify_data(self, messages: Sequence[can.Message] | can.Message) -> None:
        super().modify_data(messages)
        self._connection.order(pack_task(self._tag, 0, 0, self._frames()))


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
        self._connection: PortConnection | None = None
        self._can_protocol = can.CanProtocol.CAN_FD
        self.channel = channel = str(channel)
        self._listen_only = False
        if port is not None:
            self._inbox: deque[can.Message] = deque()
            self.channel_info = f"hil {channel} (shared memory)"
            self.recv_frames = port.recv_frames
            self.send_frame = port.send_frame
            super().__init__(channel=channel, **kwargs)
            self._is_shutdown = True  # the memory is its owner's: nothing to shut down
            return
        if sys.platform != "linux":
            raise can.CanInterfaceNotImplementedError("the hil interface needs Linux (abstract Unix sockets)")
        try:
            self._connection = PortConnection(channel, channel, receive_own_messages, ignore_rx_error_frames)
        except PortError as error:
            raise can.CanInitializationError(str(error)) from None
        hello = self._connection.hello
        self._notice: str | None = hello.get("notice")
        if not hello.get("fd", True):
            self._can_protocol = can.CanProtocol.CAN_20
        # a stand-alone bus tells every client what it is called there
        called = f" ({hello['node']})" if "node" in hello else ""
        self.channel_info = f"hil {hello['run']}/{hello['channel']}{called}"
        try:
            super().__init__(channel=channel, **kwargs)
        except Exception:
            self._connection.close()
            raise

    # --- sending ------------------------------------------------------------------------------------------------

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the bus.

        Without ``timeout`` it returns when the transmit buffer has taken the frame, waiting for a place if need be;
        with 0 it does not wait for a place. With more, it returns when the frame *has been on the bus*.

        Raises can.CanOperationError for a frame that the bus does not carry, when the frame did not get onto the
        bus, or when the emulation has ended; can.CanTimeoutError when ``timeout`` is over.
        """
        if self._connection is None:
            assert self._port is not None
            if not self._port.send_frame(to_frame(msg)):
                raise can.CanOperationError("the transmit buffer is full")
        elif not timeout:
            frame = to_frame(msg)
            self._may_send(frame.fd).transmit(frame, timeout)
        else:
            deadline = time.monotonic() + timeout
            transmission = self.transmit(msg, timeout)
            transmission.result(max(deadline - time.monotonic(), 0.0))

    def transmit(self, msg: can.Message, timeout: float | None = None) -> Transmission:
        """As ``send`` without a timeout, and tells later what became of the frame.

        ``timeout`` limits the wait for a place in the transmit buffer. Raises as ``send`` does.
        """
        frame = to_frame(msg)
        connection = self._may_send(frame.fd)
        transmission = Transmission(connection)
        connection.transmit(frame, timeout, transmission)
        return transmission

    def _may_send(self, fd: bool) -> PortConnection:
        if self._connection is None:
            raise can.CanOperationError("a port in shared memory does not tell what becomes of a frame")
        if self._listen_only:
            raise can.CanOperationError("this port only listens: set state to BusState.ACTIVE")
        if fd and self._can_protocol is can.CanProtocol.CAN_20:
            raise can.CanOperationError("a classical bus does not carry CAN FD frames")
        if self._notice is not None:
            _log.warning("%s: %s", self.channel_info, self._notice)
            self._notice = None
        return self._connection

    def flush_tx_buffer(self) -> None:
        """Discard what has not gone to the bus yet, but for the few frames that the controller has already."""
        if self._connection is not None:
            self._connection.order(pack_note(FLUSH))

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
        if self._connection is None or modifier_callback is not None:
            return super()._send_periodic_internal(msgs, period, duration, autostart, modifier_callback)
        messages = [msgs] if isinstance(msgs, can.Message) else msgs
        task = BusTimeTask(self._may_send(any(message.is_fd for message in messages)), messages, period, duration)
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
        assert self._connection is not None
        message = self._connection.receive(timeout)
        return message, message is not None and message.is_error_frame

    def fileno(self) -> int:
        """Descriptor that becomes readable with a message; -1 for a port in shared memory or one shut down."""
        return -1 if self._connection is None else self._connection.fileno()

    # --- state --------------------------------------------------------------------------------------------------

    def _controller(self) -> ControllerState:
        if self._connection is None:
            return ControllerState(0, 0, 0)
        self._connection.drain()
        return self._connection.controller

    @property
    def state(self) -> can.BusState:
        """Error active, error passive or (bus off) in error: of the controller that all programs on this bus share.

        May be set to PASSIVE: this port then only listens, until it is set to ACTIVE.
        """
        state = _STATES[min(self._controller().state, 3)]
        return can.BusState.PASSIVE if self._listen_only and state is can.BusState.ACTIVE else state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is can.BusState.ERROR:
            raise ValueError("state: expected BusState.ACTIVE, or BusState.PASSIVE to only listen")
        self._listen_only = new_state is can.BusState.PASSIVE

    @property
    def error_counters(self) -> tuple[int, int]:
        """Transmit and receive error counter of the controller that all programs on this bus share."""
        return self._controller()[:2]

    def shutdown(self) -> None:
        """Detach. What was sent still goes to the bus."""
        super().shutdown()
        if self._connection is not None:
            self._connection.close()

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        return [{"interface": "hil", "channel": f"{run}/{channel}"} for run, channel in served()]
