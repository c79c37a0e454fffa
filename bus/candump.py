"""Lines of a candump log (``candump -L``), with nanoseconds."""

from __future__ import annotations

from bus.frames import Frame

_BRS, _FDF = 0x1, 0x4


def format_line(time_ns: int, channel: str, frame: Frame) -> str:
    """``(seconds.nanoseconds) channel ID##FLAGSDATA`` for a CAN FD frame, ``ID#DATA`` for a classical one."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    identifier = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
    if frame.fd:
        body = f"{identifier}##{_FDF | (_BRS if frame.brs else 0):X}{frame.data.hex().upper()}"
    else:
        body = f"{identifier}#{frame.data.hex().upper()}"
    return f"({seconds}.{nanoseconds:09d}) {channel} {body}"
