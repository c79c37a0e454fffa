"""The CAN frame as nodes exchange it."""

from __future__ import annotations

from typing import NamedTuple

CAN_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
BASE_ID_LIMIT = 1 << 11
EXTENDED_ID_LIMIT = 1 << 29


class InvalidFrameError(ValueError):
    """A frame that no CAN controller could send: identifier, length or bit-rate switch out of range."""


class Frame(NamedTuple):
    """A data or remote frame. ``fd`` frames switch to the data bit rate after arbitration when ``brs`` is set.

    A remote frame carries no data: only the length of ``data`` counts, as its DLC. ``esi`` of a CAN FD frame tells
    that its sender is error passive.
    """

    id: int
    data: bytes
    fd: bool = True
    brs: bool = True
    extended: bool = False
    remote: bool = False
    esi: bool = False


class ErrorFrame(NamedTuple):
    """What a controller tells its application of an error, as SocketCAN puts it (``linux/can/error.h``).

    classes: error classes (``CAN_ERR_*``, without ``CAN_ERR_FLAG``). data: eight bytes; the last two are the
    transmit and receive error counters.
    """

    classes: int
    data: bytes


def is_valid(
    identifier: int, length: int, fd: bool, brs: bool, extended: bool, remote: bool = False, esi: bool = False
) -> bool:
    """Whether a frame of these properties exists: 11 or 29 bit identifier, a length that a DLC can express, neither
    bit-rate switch nor error state in a classical frame, no remote frame in CAN FD."""
    if not 0 <= identifier < (EXTENDED_ID_LIMIT if extended else BASE_ID_LIMIT):
        return False
    return length in CAN_FD_LENGTHS and not remote if fd else length <= 8 and not (brs or esi)


def checked(frame: Frame) -> Frame:
    """``frame`` itself. Raises InvalidFrameError with the reason when no controller could send it."""
    limit = EXTENDED_ID_LIMIT if frame.extended else BASE_ID_LIMIT
    if not 0 <= frame.id < limit:
        bits = 29 if frame.extended else 11
        raise InvalidFrameError(f"identifier {frame.id:#x} does not fit into {bits} bits")
    if frame.fd and len(frame.data) not in CAN_FD_LENGTHS:
        raise InvalidFrameError(f"no CAN FD frame has {len(frame.data)} bytes, only {CAN_FD_LENGTHS}")
    if not frame.fd and len(frame.data) > 8:
        raise InvalidFrameError(f"a classical CAN frame carries at most 8 bytes, not {len(frame.data)}")
    if frame.brs and not frame.fd:
        raise InvalidFrameError("a classical CAN frame has no bit-rate switch")
    if frame.esi and not frame.fd:
        raise InvalidFrameError("a classical CAN frame has no error state indicator")
    if frame.remote and frame.fd:
        raise InvalidFrameError("CAN FD has no remote frames")
    return frame
