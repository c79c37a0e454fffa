"""A port in shared memory, for a firmware process. A slot of a ring: identifier u32, flags u8, length u8 (see
``bus.records``), two bytes unused, 64 bytes of data."""

from __future__ import annotations

import struct

from bus.frames import Frame, is_valid
from bus.records import BRS, ESI, EXTENDED, FD, FLAGS, REMOTE

_SLOTS = 32  # frames that can wait in one direction
_SLOT = struct.Struct("<IBB2x64s")
_SLOT_SIZE = _SLOT.size


class _Ring:
    """Single producer, single consumer. The lockstep hands over by eventfd, which orders the memory and lets
    only one side run at a time: no locks."""

    SIZE = 16 + _SLOTS * _SLOT_SIZE

    def __init__(self, memory: memoryview) -> None:
        self._ends = memory[:16].cast("q")  # written, read
        self._slots = memory[16 : self.SIZE]
        self.overruns = 0
        self.malformed = 0  # slots that hold no frame

    def put(self, frame: Frame) -> bool:
        """Append ``frame``; False when the ring is full, as a controller's buffer would overrun."""
        ends = self._ends
        if ends[0] - ends[1] >= _SLOTS:
            self.overruns += 1
            return False
        written = ends[0]
        identifier, data, fd, brs, extended, remote, esi = frame
        flags = (FD if fd else 0) | (BRS if brs else 0) | (EXTENDED if extended else 0)
        if remote or esi:
            flags |= (REMOTE if remote else 0) | (ESI if esi else 0)
        _SLOT.pack_into(self._slots, written % _SLOTS * _SLOT_SIZE, identifier, flags, len(data), data)
        ends[0] = written + 1
        return True

    def take(self) -> list[Frame]:
        """All frames that wait, oldest first; what no controller could send is dropped and counted."""
        ends = self._ends
        written, read = ends[0], ends[1]
        if written == read:
            return []
        frames: list[Frame] = []
        ends[1] = written
        if not 0 < written - read <= _SLOTS:
            self.malformed += 1
            return frames
        for n in range(read, written):
            identifier, flags, length, data = _SLOT.unpack_from(self._slots, n % _SLOTS * _SLOT_SIZE)
            properties = FLAGS[flags]
            if properties is None:
                self.malformed += 1
                continue
            fd, brs, extended, remote, esi = properties
            if is_valid(identifier, length, fd, brs, extended):
                frames.append(Frame(identifier, data[:length], fd, brs, extended, remote, esi))
            else:
                self.malformed += 1
        return frames


class ShmPort:
    """A port in ``SIZE`` bytes of shared memory; ``firmware=True`` is the mirror image for the firmware."""

    SIZE = 2 * _Ring.SIZE

    def __init__(self, memory: memoryview, firmware: bool = False) -> None:
        down, up = _Ring(memory[: _Ring.SIZE]), _Ring(memory[_Ring.SIZE : self.SIZE])
        self._outgoing, self._incoming = (up, down) if firmware else (down, up)

    def send_frame(self, frame: Frame) -> bool:
        """Hand ``frame`` to the other side; False when it does not take any more."""
        return self._outgoing.put(frame)

    def recv_frames(self) -> list[Frame]:
        """Frames from the other side."""
        return self._incoming.take()

    @property
    def malformed(self) -> int:
        """What came from the other side and was no frame."""
        return self._incoming.malformed
