"""python-can interface ``hil``: a port on an emulated bus, ``can.Bus(interface="hil", channel="left_leg")``.

Timestamps are bus time in seconds. Sending hands the frame to the bus, which arbitrates; an error is raised only when
the emulation is gone. A run to which a tool sends is no longer reproducible from its scenario alone.
"""

from __future__ import annotations

import select
from typing import Any

import can

from bus.frames import Frame, InvalidFrameError, checked
from bus.ports import (
    RECORD_SIZE,
    MalformedRecordError,
    PortError,
    ShmPort,
    connect,
    pack_frame,
    served,
    unpack_frame,
)


def to_message(frame: Frame, time_ns: int, channel: str) -> can.Message:
    """python-can's form of ``frame``."""
    return can.Message(
        timestamp=time_ns * 1e-9,
        arbitration_id=frame.id,
        is_extended_id=frame.extended,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
        data=frame.data,
        channel=channel,
        check=False,
    )


def to_frame(message: can.Message) -> Frame:
    """Frame of a python-can message. Raises can.CanOperationError for one that this bus does not carry."""
    if message.is_remote_frame or message.is_error_frame:
        raise can.CanOperationError("remote and error frames cannot be sent on an emulated bus")
    frame = Frame(
        message.arbitration_id, bytes(message.data), message.is_fd, message.bitrate_switch, message.is_extended_id
    )
    try:
        return checked(frame)
    except InvalidFrameError as error:
        raise can.CanOperationError(str(error)) from None


class HilBus(can.BusABC):
    """A port on an emulated bus.

    Args:
        channel: name of the bus ("left_leg"), or "RUN/left_leg" when several runs go on.
        port: a port in shared memory; only the emulation itself has one to give.
    """

    def __init__(self, channel: str = "", *, port: ShmPort | None = None, **kwargs: Any) -> None:
        self._port = port
        self._socket = None
        if port is not None:
            # the firmware's way: raw frames, no filters, nothing of BusABC's bookkeeping
            self.channel_info = f"hil {channel} (shared memory)"
            self._is_shutdown = True
            self.recv_frames = port.recv_frames
            self.send_frame = port.send_frame
            return
        try:
            self._socket, hello = connect(channel)
        except PortError as error:
            raise can.CanInitializationError(str(error)) from None
        self.channel = channel
        self.channel_info = f"hil {hello['run']}/{hello['channel']}"
        self._can_protocol = can.CanProtocol.CAN_FD
        super().__init__(channel=channel, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the bus."""
        record = pack_frame(to_frame(msg))
        try:
            self._socket.settimeout(timeout)
            self._socket.send(record)
        except TimeoutError:
            raise can.CanOperationError("the bus did not take the frame in time") from None
        except OSError as error:
            raise can.CanOperationError(f"the emulation has ended ({error})") from None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        ready, _, _ = select.select([self._socket], [], [], timeout)
        if not ready:
            return None, False
        try:
            record = self._socket.recv(RECORD_SIZE + 1)
        except OSError as error:
            raise can.CanOperationError(f"the emulation has ended ({error})") from None
        if not record:
            raise can.CanOperationError("the emulation has ended")
        try:
            time_ns, _, frame = unpack_frame(record)
        except MalformedRecordError as error:
            raise can.CanOperationError(f"not a frame: {error}") from None
        return to_message(frame, time_ns, self.channel), False

    def fileno(self) -> int:
        return self._socket.fileno() if self._socket is not None else -1

    def shutdown(self) -> None:
        """Detach."""
        if self._socket is not None:
            super().shutdown()
            self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[dict[str, Any]]:
        return [{"interface": "hil", "channel": f"{run}/{channel}"} for run, channel in served()]
