"""python-can interface ``hil``: a port on an emulated bus, ``can.Bus(interface="hil", channel="left_leg")``.

Timestamps are bus time in seconds. Sending hands the frame to the bus, which arbitrates: that it was taken
does not mean that it was sent. A run to which a tool sends is no longer reproducible from its scenario
alone.
"""

from __future__ import annotations

import select
import socket
import sys
from collections import deque
from typing import Any

import can

from bus.frames import Frame, InvalidFrameError, checked
from bus.ports import (
    RECORD_SIZE,
    MalformedRecordError,
    PortError,
    ShmPort,
    connect,
    is_own,
    pack_frame,
    served,
    unpack_frame,
)


def to_message(frame: Frame, time_ns: int, channel: str, own: bool = False) -> can.Message:
    """python-can's form of ``frame``; ``own``: it comes back to its sender."""
    return can.Message(
        timestamp=time_ns * 1e-9,
        arbitration_id=frame.id,
        is_extended_id=frame.extended,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
        data=frame.data,
        channel=channel,
        is_rx=not own,
        check=False,
    )


def to_frame(message: can.Message) -> Frame:
    """Frame of a python-can message. Raises can.CanOperationError for one that this bus does not carry."""
    if message.is_remote_frame or message.is_error_frame:
        raise can.CanOperationError("remote and error frames cannot be sent on an emulated bus")
    frame = Frame(
        message.arbitration_id,
        bytes(message.data),
        message.is_fd,
        message.bitrate_switch,
        message.is_extended_id,
    )
    try:
        return checked(frame)
    except InvalidFrameError as error:
        raise can.CanOperationError(str(error)) from None


class HilBus(can.BusABC):
    """A port on an emulated bus.

    Args:
        channel: name of the bus ("left_leg"), or "RUN/left_leg" when several runs go on.
        receive_own_messages: also receive what this port sent, once it has been on the bus.
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
        port: ShmPort | None = None,
        **kwargs: Any,
    ) -> None:
        self._port = port
        self._socket: socket.socket | None = None
        self._receive_own = receive_own_messages
        self._can_protocol = can.CanProtocol.CAN_FD
        self.channel = channel = str(channel)
        if port is not None:
            self._inbox: deque[Frame] = deque()
            self.channel_info = f"hil {channel} (shared memory)"
            self.recv_frames = port.recv_frames
            self.send_frame = port.send_frame
            super().__init__(channel=channel, **kwargs)
            self._is_shutdown = True  # the memory is its owner's: nothing to shut down
            return
        if sys.platform != "linux":
            raise can.CanInterfaceNotImplementedError("the hil interface needs Linux (abstract Unix sockets)")
        try:
            self._socket, hello = connect(channel)
        except PortError as error:
            raise can.CanInitializationError(str(error)) from None
        self.channel_info = f"hil {hello['run']}/{hello['channel']}"
        super().__init__(channel=channel, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the bus, waiting at most ``timeout`` seconds for it to be taken.

        Raises can.CanOperationError for a frame that the bus does not carry, when it does not take the frame
        in time, or when the emulation has ended.
        """
        frame = to_frame(msg)
        if self._port is not None:
            if not self._port.send_frame(frame):
                raise can.CanOperationError("the transmit buffer is full")
            return
        connection = self._open_socket()
        try:
            connection.settimeout(timeout)
            connection.send(pack_frame(frame))
        except (TimeoutError, BlockingIOError):
            raise can.CanOperationError("the bus did not take the frame in time") from None
        except OSError as error:
            raise can.CanOperationError(f"the emulation has ended ({error})") from None

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message that the filters let pass, None when there is none within ``timeout`` seconds.

        Raises can.CanOperationError when the emulation has ended.
        """
        if self._port is None:
            return super().recv(timeout)
        inbox = self._inbox
        inbox.extend(self._port.recv_frames())
        while inbox:
            message = to_message(inbox.popleft(), 0, self.channel)
            if self._matches_filters(message):
                return message
        return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        connection = self._open_socket()
        while True:
            ready, _, _ = select.select([connection], [], [], timeout)
            if not ready:
                return None, False
            try:
                record = connection.recv(RECORD_SIZE + 1)
            except OSError as error:
                raise can.CanOperationError(f"the emulation has ended ({error})") from None
            if not record:
                raise can.CanOperationError("the emulation has ended")
            try:
                time_ns, _, frame = unpack_frame(record)
            except MalformedRecordError as error:
                raise can.CanOperationError(f"not a frame: {error}") from None
            own = is_own(record)
            if self._receive_own or not own:
                return to_message(frame, time_ns, self.channel, own), False
            if timeout is not None:
                timeout = 0.0  # what waits behind it

    def _open_socket(self) -> socket.socket:
        if self._socket is None or self._socket.fileno() < 0:
            raise can.CanOperationError("this port is shut down")
        return self._socket

    def fileno(self) -> int:
        """Descriptor that becomes readable with a message; -1 for a port in shared memory."""
        return self._socket.fileno() if self._socket is not None else -1

    def shutdown(self) -> None:
        """Detach."""
        super().shutdown()
        if self._socket is not None:
            self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        return [{"interface": "hil", "channel": f"{run}/{channel}"} for run, channel in served()]
