"""Tools on the SocketCAN interface of a whole bus, beside those on its sockets."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import can

from bus.frames import ErrorFrame, Frame
from bus.socketcan import LostFramesError, SocketCanPort
from hil.errors import EmulationError


@contextlib.contextmanager
def reported() -> Iterator[None]:
    try:
        yield
    except (LostFramesError, can.CanError, OSError) as error:
        raise EmulationError(f"SocketCAN: {error}") from None


class ToolInterfaces:
    """The interface of each whole bus, as a tap: shows every frame, takes the frames of tools.

    A frame of a tool is on the interface when the tool sends it, and not once more when the wire has carried it.
    """

    def __init__(self, buses: Sequence[str]) -> None:
        self._ends = [SocketCanPort(name) for name in buses]
        self._own: list[deque[Frame]] = [deque(maxlen=256) for _ in buses]

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        own = self._own[bus]
        if frame in own:
            own.remove(frame)
            return
        with reported():
            self._ends[bus].send_frame(frame)

    def broadcast_error(self, bus: int, time_ns: int, sender: int, error: ErrorFrame) -> None:
        with reported():
            self._ends[bus].send_error(error)

    def set_state(self, bus: int, tec: int, rec: int, state: int) -> None:
        """SocketCAN tells of a controller's state by error frames alone."""

    def refused(self, bus: int, frame: Frame) -> None:
        """The wire has not taken ``frame``, which is not to be left out when somebody else sends it."""
        if frame in self._own[bus]:
            self._own[bus].remove(frame)

    def poll(self) -> list[tuple[int, Frame]]:
        received = []
        for bus, end in enumerate(self._ends):
            for frame in end.waiting()[1]:
                self._own[bus].append(frame)
                received.append((bus, frame))
        return received

    def close(self) -> None:
        for end in self._ends:
            end.shutdown()


class Taps:
    """Several taps as one."""

    def __init__(self, taps: Sequence[Any]) -> None:
        self._taps = list(taps)
        self._polled: list[tuple[Any, tuple[int, Frame]]] = []

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        for tap in self._taps:
            tap.broadcast(bus, time_ns, sender, frame)

    def poll(self) -> list[tuple[int, Frame]]:
        self._polled = [(tap, item) for tap in self._taps for item in tap.poll()]
        return [item for _, item in self._polled]

    def refused(self, bus: int, frame: Frame) -> None:
        """A frame of the last ``poll``: told to the tap that it is from."""
        for tap, (its_bus, its_frame) in self._polled:
            if its_bus == bus and its_frame is frame:
                tap.refused(bus, frame)

    def broadcast_error(self, bus: int, time_ns: int, sender: int, error: ErrorFrame) -> None:
        for tap in self._taps:
            tap.broadcast_error(bus, time_ns, sender, error)

    def set_state(self, bus: int, tec: int, rec: int, state: int) -> None:
        for tap in self._taps:
            tap.set_state(bus, tec, rec, state)

    def close(self) -> None:
        for tap in self._taps:
            tap.close()
