"""Lines of a candump log (``candump -L``), with nanoseconds."""

from __future__ import annotations

from bus.frames import ErrorFrame, Frame

_BRS, _ESI, _FDF = 0x1, 0x2, 0x4
ERROR_FLAG = 0x20000000  # CAN_ERR_FLAG


def format_line(time_ns: int, channel: str, frame: Frame | ErrorFrame) -> str:
    """``(seconds.nanoseconds) channel`` and ``ID##FLAGSDATA`` for a CAN FD frame, ``ID#DATA`` for a classical one,
    ``ID#RDLC`` for a remote frame (``ID#R`` when its DLC is 0), ``2CLASSES#DATA`` for an error frame."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    if len(frame) == 2:
        classes, data = frame
        return f"({seconds}.{nanoseconds:09d}) {channel} {ERROR_FLAG | classes:08X}#{data.hex().upper()}"
    can_id, data, fd, brs, extended, remote, esi = frame
    identifier = f"{can_id:08X}" if extended else f"{can_id:03X}"
    if fd:
        flags = _FDF | (_BRS if brs else 0) | (_ESI if esi else 0)
        body = f"{identifier}##{flags:X}{data.hex().upper()}"
    elif remote:
        body = f"{identifier}#R{len(data) or ''}"
    else:
        body = f"{identifier}#{data.hex().upper()}"
    return f"({seconds}.{nanoseconds:09d}) {channel} {body}"
