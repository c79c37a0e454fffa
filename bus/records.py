"""What a port's socket carries: one record per packet.

A record, little-endian: time i64 (ns of bus time), identifier u32, tag u32, kind u8, flags u8, sender u8 (port of the
wire), length u8, data. By kind:

=========  ============  ======================================================================================
kind       direction     meaning
=========  ============  ======================================================================================
FRAME      both          a frame; from a client its tag is a number of the client's choice, never 0
OWN        to client     a frame of this client's has been on the bus; tag as sent, 0 for a periodic one
UNSEEN     to client     the frame of this tag did not appear on the bus within a second of bus time
FLUSHED    to client     the frame of this tag was discarded before it went to the bus
ERROR      to client     identifier: error classes; data: eight bytes (``linux/can/error.h``)
STATE      to client     of the bus controller that all clients share; data: TEC u16, REC u16, state u8
FLUSH      from client   discard what has not gone to the bus yet
PERIODIC   from client   start task ``tag``, or exchange its frames when time is 0; time: its period, ns;
                         data: duration i64 (ns, -1 endless), then the records of its frames
STOP       from client   stop task ``tag``
=========  ============  ======================================================================================

Of a remote frame the length is its DLC and data follows as zeros. In PERIODIC length is unused.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from bus.frames import ErrorFrame, Frame, is_valid

VERSION = 2
FRAME, OWN, UNSEEN, FLUSHED, ERROR, STATE, FLUSH, PERIODIC, STOP = range(9)
TASK_FRAMES = 32  # most frames of one periodic task

FD, BRS, EXTENDED, REMOTE, ESI = 1, 2, 4, 8, 16
HEADER = struct.Struct("<qIIBBBB")
RECORD_SIZE = HEADER.size + 64
LARGEST = HEADER.size + 8 + TASK_FRAMES * RECORD_SIZE
_DURATION = struct.Struct("<q")
_STATE = struct.Struct("<HHB")


class MalformedRecordError(ValueError):
    """Bytes that are not a frame."""


class ControllerState(NamedTuple):
    """Error counters of a CAN controller, and its state by the kernel's ``enum can_state``: 0 error active, 1 warning,
    2 error passive, 3 bus off."""

    tec: int
    rec: int
    state: int


def _flags(n: int) -> tuple[bool, bool, bool, bool, bool] | None:
    fd, brs, extended, remote, esi = (bool(n & bit) for bit in (FD, BRS, EXTENDED, REMOTE, ESI))
    if n > 31 or (remote if fd else brs or esi):
        return None
    return fd, brs, extended, remote, esi


FLAGS = tuple(_flags(n) for n in range(256))  # (fd, brs, extended, remote, esi); None: no such frame


def flags_of(frame: Frame) -> int:
    """The flags of ``frame`` in one byte."""
    _, _, fd, brs, extended, remote, esi = frame
    flags = EXTENDED if extended else 0
    if fd:
        flags |= FD | BRS if brs else FD
    elif brs:
        flags |= BRS  # no such frame: whoever takes it will say so
    if remote:
        flags |= REMOTE
    return flags | ESI if esi else flags


def pack_frame(frame: Frame, time_ns: int = 0, sender: int = 0, kind: int = FRAME, tag: int = 0) -> bytes:
    """The record of ``frame``."""
    data = bytes(len(frame.data)) if frame.remote else frame.data
    return HEADER.pack(time_ns, frame.id, tag, kind, flags_of(frame), sender, len(data)) + data


def unpack_frame(record: bytes) -> tuple[int, int, Frame]:
    """Time in ns, sender and frame of a record of kind FRAME or OWN. Raises MalformedRecordError."""
    if len(record) < HEADER.size:
        raise MalformedRecordError(f"a record of {len(record)} bytes")
    time_ns, identifier, _, kind, flags, sender, length = HEADER.unpack_from(record)
    properties = FLAGS[flags]
    if kind > OWN or properties is None or len(record) != HEADER.size + length:
        raise MalformedRecordError("kind, flags or length do not fit")
    fd, brs, extended, remote, esi = properties
    if not is_valid(identifier, length, fd, brs, extended):
        raise MalformedRecordError(f"no controller could send identifier {identifier:#x} with {length} bytes")
    data = bytes(length) if remote else record[HEADER.size :]
    return time_ns, sender, Frame(identifier, data, fd, brs, extended, remote, esi)


def kind_and_tag(record: bytes) -> tuple[int, int]:
    """Kind and tag of a record of at least a header's length; raises MalformedRecordError for a shorter one."""
    if len(record) < HEADER.size:
        raise MalformedRecordError(f"a record of {len(record)} bytes")
    return record[16], int.from_bytes(record[12:16], "little")


def pack_note(kind: int, tag: int = 0, time_ns: int = 0) -> bytes:
    """A record of a kind that has no data."""
    return HEADER.pack(time_ns, 0, tag, kind, 0, 0, 0)


def pack_error(error: ErrorFrame, time_ns: int, sender: int) -> bytes:
    """The record of an error frame."""
    return HEADER.pack(time_ns, error.classes, 0, ERROR, 0, sender, len(error.data)) + error.data


def unpack_error(record: bytes) -> tuple[int, ErrorFrame]:
    """Time in ns and error frame of a record of kind ERROR. Raises MalformedRecordError."""
    if len(record) != HEADER.size + 8:
        raise MalformedRecordError("an error frame has eight bytes")
    time_ns, classes, _, _, _, _, _ = HEADER.unpack_from(record)
    if classes >> 29:
        raise MalformedRecordError(f"no error classes: {classes:#x}")
    return time_ns, ErrorFrame(classes, record[HEADER.size :])


def pack_state(state: ControllerState) -> bytes:
    """The record of a controller's state."""
    return HEADER.pack(0, 0, 0, STATE, 0, 0, _STATE.size) + _STATE.pack(*state)


def unpack_state(record: bytes) -> ControllerState:
    """Of a record of kind STATE. Raises MalformedRecordError."""
    if len(record) != HEADER.size + _STATE.size:
        raise MalformedRecordError("a controller's state has five bytes")
    return ControllerState(*_STATE.unpack_from(record, HEADER.size))


def pack_task(tag: int, period_ns: int, duration_ns: int, frames: list[Frame]) -> bytes:
    """The record of a periodic task; ``period_ns`` 0 exchanges the frames of a running one."""
    head = HEADER.pack(period_ns, 0, tag, PERIODIC, 0, 0, 0)
    return head + _DURATION.pack(duration_ns) + b"".join(map(pack_frame, frames))


def unpack_task(record: bytes) -> tuple[int, int, list[Frame]]:
    """Period and duration in ns, and the frames of a record of kind PERIODIC. Raises MalformedRecordError."""
    at = HEADER.size + _DURATION.size
    if len(record) < at:
        raise MalformedRecordError("a periodic task without a duration")
    period_ns, duration_ns = HEADER.unpack_from(record)[0], _DURATION.unpack_from(record, HEADER.size)[0]
    frames: list[Frame] = []
    while at < len(record):
        if len(record) < at + HEADER.size:
            raise MalformedRecordError("a periodic task ends within a frame")
        end = at + HEADER.size + record[at + HEADER.size - 1]
        frames.append(unpack_frame(record[at:end])[2])
        at = end
    if period_ns < 0 or not 0 < len(frames) <= TASK_FRAMES:
        raise MalformedRecordError(f"a periodic task of {len(frames)} frames, {period_ns} ns apart")
    return period_ns, duration_ns, frames
