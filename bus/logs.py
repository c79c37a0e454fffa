"""Logs of a bus for stock tools, beside candump's: ASC and BLF (Vector), PCAP (Wireshark).

What each keeps is in docs/tools.md. All formats count time from the start of the run.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from bus.candump import ERROR_FLAG
from bus.frames import ErrorFrame, Frame

_BLF_CONTAINER = 16 * 1024  # bytes that BLF collects before it writes
FORMATS = ("candump", "asc", "blf", "pcap")
Entry = tuple[int, Frame | ErrorFrame]  # time in ns, what came


class Log(Protocol):
    """A file that grows: what has been written is with the operating system when ``write`` returns, but for BLF's
    last 16 kB."""

    def write(self, entries: Sequence[Entry]) -> None: ...
    def close(self) -> None: ...


def open_log(name: str, path: Path, number: int) -> Log:
    """A log of format ``name`` (but candump) at ``path``; ``number``, from 1, stands for the bus's name in it."""
    if name == "pcap":
        return PcapLog(path)
    return VectorLog(path, number)


class PcapLog:
    """libpcap with nanoseconds, of link type LINKTYPE_CAN_SOCKETCAN: its identifiers are big-endian.

    https://www.tcpdump.org/linktypes/LINKTYPE_CAN_SOCKETCAN.html
    """

    _HEADER = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 72, 227)
    _PACKET = struct.Struct("<IIII")
    _FRAME = struct.Struct(">IBBxx")
    _BRS, _ESI, _FDF = 0x1, 0x2, 0x4
    _EXTENDED, _REMOTE = 0x80000000, 0x40000000

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._file.write(self._HEADER)

    def write(self, entries: Sequence[Entry]) -> None:
        self._file.write(b"".join(self._packet(time_ns, frame) for time_ns, frame in entries))
        self._file.flush()

    def _packet(self, time_ns: int, frame: Frame | ErrorFrame) -> bytes:
        flags = 0
        if isinstance(frame, ErrorFrame):
            identifier, data = ERROR_FLAG | frame.classes, frame.data
        else:
            identifier, data, fd, brs, extended, remote, esi = frame
            if extended:
                identifier |= self._EXTENDED
            if remote:
                identifier |= self._REMOTE
            if fd:
                flags = self._FDF | (self._BRS if brs else 0) | (self._ESI if esi else 0)
        size = 8 + len(data)
        head = self._PACKET.pack(*divmod(time_ns, 1_000_000_000), size, size)
        return head + self._FRAME.pack(identifier, len(data), flags) + data

    def close(self) -> None:
        self._file.close()


class VectorLog:
    """ASC or BLF, by the suffix of ``path``, through python-can's writers."""

    def __init__(self, path: Path, number: int) -> None:
        import can

        from bus.can_messages import to_error_message, to_message

        self._to_message, self._to_error = to_message, to_error_message
        self._writer: Any
        self._half = 0.0
        if path.suffix == ".blf":
            self._writer = can.BLFWriter(path, channel=number, max_container_size=_BLF_CONTAINER)
            self._writer.start_timestamp = 0.0  # not that of the first frame
            self._half = 0.5e-9  # the writer rounds down to nanoseconds
        else:
            self._writer = can.ASCWriter(path, channel=number)
            self._writer.log_event("// seconds from the start of the run", 0.0)  # not from the first frame

    def write(self, entries: Sequence[Entry]) -> None:
        writer, half = self._writer, self._half
        for time_ns, frame in entries:
            if isinstance(frame, ErrorFrame):
                message = self._to_error(frame, time_ns, None)
            else:
                message = self._to_message(frame, time_ns, None)
            message.timestamp += half
            writer.on_message_received(message)
        writer.file.flush()

    def close(self) -> None:
        self._writer.stop()
