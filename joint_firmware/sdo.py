"""The SDO server of a node (CiA 301 §7.2.4): expedited and segmented transfers. Block transfer is refused."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from joint_firmware.object_dictionary import AbortCode, ObjectDictionary, SdoAbort

NEVER = 1 << 62  # a tick that does not come

_HEAD = struct.Struct("<BHB")
_HEAD_AND_SIZE = struct.Struct("<BHBI")
_SIZE = struct.Struct("<I")
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)  # client command specifiers
_DOWNLOAD_ANSWER, _DOWNLOAD_SEGMENT_ANSWER = 3 << 5, 1 << 5  # the server's; those of uploads are the client's
_EXPEDITED, _SIZE_TOLD, _TOGGLE, _LAST = 0x02, 0x01, 0x10, 0x01
_SEGMENT = 7  # bytes


class _Transfer(NamedTuple):
    """A segmented transfer under way. ``data``: all that is sent, ``done`` bytes of it already; or what has come."""

    upload: bool
    main: int  # index
    sub: int
    data: bytes
    done: int
    toggle: int
    size: int  # of the whole


class SdoServer:
    """One channel, one transfer at a time. A client that starts anew abandons what it had begun."""

    def __init__(self, dictionary: ObjectDictionary, timeout_ticks: int) -> None:
        self._dictionary = dictionary
        self._timeout = timeout_ticks
        self._transfer: _Transfer | None = None
        self.deadline = NEVER  # tick at which the client has been silent for too long

    def request(self, data: bytes, tick: int) -> bytes | None:
        """The answer to a request of eight bytes, None when there is none to give."""
        command, index, sub = _HEAD.unpack_from(data)
        specifier = command >> 5
        transfer = self._transfer
        segment = specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT)
        if segment:
            index, sub = (transfer.main, transfer.sub) if transfer is not None else (0, 0)
        else:
            self.close()
        try:
            if specifier == _DOWNLOAD:
                return self._download(command, index, sub, data, tick)
            if specifier == _UPLOAD:
                return self._upload(index, sub, tick)
            if specifier == _ABORT:
                return None
            if not segment or transfer is None or transfer.upload != (specifier == _UPLOAD_SEGMENT):
                raise SdoAbort(AbortCode.COMMAND)
            if command & _TOGGLE != transfer.toggle:
                raise SdoAbort(AbortCode.TOGGLE)
            step = self._upload_segment if transfer.upload else self._download_segment
            return step(transfer, command, data, tick)
        except SdoAbort as abort:
            self.close()
            return _HEAD_AND_SIZE.pack(_ABORT << 5, index, sub, abort.code)

    def expire(self) -> bytes:
        """Give up the transfer whose client has fallen silent; returns what tells the client so."""
        assert self._transfer is not None
        _, index, sub, *_ = self._transfer
        self.close()
        return _HEAD_AND_SIZE.pack(_ABORT << 5, index, sub, AbortCode.TIMEOUT)

    def close(self) -> None:
        """Forget the transfer under way."""
        self._transfer = None
        self.deadline = NEVER

    def _go_on(self, transfer: _Transfer, tick: int) -> None:
        self._transfer = transfer
        self.deadline = tick + self._timeout

    # --- upload: the client reads ---------------------------------------------------------------------------

    def _upload(self, index: int, sub: int, tick: int) -> bytes:
        data = self._dictionary.read(index, sub)
        size = len(data)
        if 0 < size <= 4:
            command = _UPLOAD << 5 | 4 - size << 2 | _EXPEDITED | _SIZE_TOLD
            return _HEAD.pack(command, index, sub) + data.ljust(4, b"\0")
        self._go_on(_Transfer(True, index, sub, data, 0, 0, size), tick)
        return _HEAD_AND_SIZE.pack(_UPLOAD << 5 | _SIZE_TOLD, index, sub, size)

    def _upload_segment(self, transfer: _Transfer, command: int, data: bytes, tick: int) -> bytes:
        chunk = transfer.data[transfer.done : transfer.done + _SEGMENT]
        done = transfer.done + len(chunk)
        answer = transfer.toggle | _SEGMENT - len(chunk) << 1
        if done == len(transfer.data):
            answer |= _LAST
            self.close()
        else:
            self._go_on(transfer._replace(done=done, toggle=transfer.toggle ^ _TOGGLE), tick)
        return bytes([answer]) + chunk.ljust(_SEGMENT, b"\0")

    # --- download: the client writes ------------------------------------------------------------------------

    def _download(self, command: int, index: int, sub: int, data: bytes, tick: int) -> bytes:
        room = self._dictionary.writable(index, sub).size
        assert room is not None and room <= 4  # everything that can be written is a number
        if command & _EXPEDITED:
            # without a size, the data are as long as the object
            size = 4 - (command >> 2 & 3) if command & _SIZE_TOLD else room
            self._dictionary.write(index, sub, data[4 : 4 + size])
        else:
            told = _SIZE.unpack_from(data, 4)[0] if command & _SIZE_TOLD else None
            if told is not None and told != room:
                raise SdoAbort(AbortCode.TOO_LONG if told > room else AbortCode.TOO_SHORT)
            self._go_on(_Transfer(False, index, sub, b"", 0, 0, room), tick)
        return _HEAD.pack(_DOWNLOAD_ANSWER, index, sub) + bytes(4)

    def _download_segment(self, transfer: _Transfer, command: int, data: bytes, tick: int) -> bytes:
        received = transfer.data + data[1 : 8 - (command >> 1 & 7)]
        if len(received) > transfer.size:
            raise SdoAbort(AbortCode.TOO_LONG)
        if command & _LAST:
            self._dictionary.write(transfer.main, transfer.sub, received)
            self.close()
        else:
            self._go_on(transfer._replace(data=received, toggle=transfer.toggle ^ _TOGGLE), tick)
        return bytes([_DOWNLOAD_SEGMENT_ANSWER | transfer.toggle]) + bytes(7)

    # --- state ----------------------------------------------------------------------------------------------

    def snapshot(self) -> Any:
        return self._transfer, self.deadline

    def restore(self, state: Any) -> None:
        self._transfer, self.deadline = state
