"""python-can's messages and the bus's frames, from one to the other."""

from __future__ import annotations

import can

from bus.frames import ErrorFrame, Frame, InvalidFrameError, checked


def to_message(frame: Frame, time_ns: int, channel: str | None, own: bool = False) -> can.Message:
    """python-can's form of ``frame``; ``own``: it comes back to its sender."""
    return can.Message(
        timestamp=time_ns / 1e9,
        arbitration_id=frame.id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
        error_state_indicator=frame.esi,
        dlc=len(frame.data),
        data=frame.data,
        channel=channel,
        is_rx=not own,
        check=False,
    )


def to_error_message(error: ErrorFrame, time_ns: int, channel: str | None) -> can.Message:
    """python-can's form of an error frame, as its SocketCAN interface has it: the error classes
    (``linux/can/error.h``) are the identifier."""
    return can.Message(
        timestamp=time_ns / 1e9,
        arbitration_id=error.classes,
        is_extended_id=False,
        is_error_frame=True,
        dlc=len(error.data),
        data=error.data,
        channel=channel,
        check=False,
    )


def to_frame(message: can.Message) -> Frame:
    """Frame of a python-can message. Raises can.CanOperationError for one that a program cannot send."""
    if message.is_error_frame:
        raise can.CanOperationError("error frames are sent by controllers, not by programs")
    if message.is_remote_frame and message.is_fd:
        raise can.CanOperationError("CAN FD has no remote frames")
    if message.error_state_indicator and not message.is_fd:
        raise can.CanOperationError("a classical CAN frame has no error state indicator")
    frame = Frame(
        message.arbitration_id,
        bytes(min(message.dlc, 9)) if message.is_remote_frame else bytes(message.data),
        message.is_fd,
        message.bitrate_switch,
        message.is_extended_id,
        message.is_remote_frame,
        message.error_state_indicator,
    )
    try:
        return checked(frame)
    except InvalidFrameError as error:
        raise can.CanOperationError(str(error)) from None
