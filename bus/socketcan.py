"""SocketCAN: interfaces of the Linux kernel, virtual (vcan) or real, as ports of an emulated bus.

A run that creates interfaces has a process beside it that removes them when the run is gone, whatever ended it.
"""

from __future__ import annotations

import shlex
import socket
import subprocess
from collections.abc import Sequence
from types import TracebackType

import can

from bus.frames import ErrorFrame, Frame
from bus.python_can import to_frame, to_message

NAME_LENGTH = 15  # longest name of a network interface (IFNAMSIZ without its zero)
FD_MTU = 72  # bytes of struct canfd_frame: an interface with this MTU carries CAN FD
# waits for the end of its input, then removes the interfaces that its arguments name
_REMOVE = 'cat >/dev/null; for i in "$@"; do ip link delete dev "$i"; done'


class SocketCanError(RuntimeError):
    """SocketCAN cannot be had here; the message says what to type."""


class LostFramesError(RuntimeError):
    """Frames that were sent have not come through the kernel."""


def supported() -> bool:
    """Whether this kernel has CAN sockets."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def require() -> None:
    """Raises SocketCanError, with a remedy, when this kernel has no CAN sockets."""
    if not supported():
        raise SocketCanError(
            "this kernel has no CAN sockets: load them with `sudo modprobe -a can can-raw vcan`, or use user-mode "
            "Linux as `hil socketcan-selftest` does"
        )


def exists(name: str) -> bool:
    """Whether there is a CAN interface of this name."""
    try:
        with open(f"/sys/class/net/{name}/type", encoding="ascii") as file:
            return int(file.read()) == 280  # ARPHRD_CAN
    except (OSError, ValueError):
        return False


def commands(names: Sequence[str]) -> str:
    """What to type to have these interfaces."""
    listed = " ".join(shlex.quote(name) for name in names)
    return f"for i in {listed}; do sudo ip link add dev $i type vcan; sudo ip link set dev $i mtu {FD_MTU} up; done"


class Interfaces:
    """The interfaces of a run: those that exist are used as they are, the others are created and removed on ``close``.

    Raises SocketCanError when the kernel has no CAN sockets, for a name that no interface can have, when another run
    uses an interface, and when one is missing and may not be created.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._remover: subprocess.Popen[bytes] | None = None
        self._claims: list[socket.socket] = []
        require()
        for name in names:
            if not 0 < len(name.encode()) <= NAME_LENGTH or set(name) & set("/: \t\n") or name in (".", ".."):
                raise SocketCanError(f"{name!r} cannot name a network interface: at most {NAME_LENGTH} bytes")
        self._claim(names)
        missing = [name for name in names if not exists(name)]
        if not missing:
            return
        self._remover = subprocess.Popen(
            ["sh", "-c", _REMOVE, "sh", *missing],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        try:
            for name in missing:
                self._ip("link", "add", "dev", name, "type", "vcan")
                self._ip("link", "set", "dev", name, "mtu", str(FD_MTU), "up")
        except (OSError, subprocess.CalledProcessError) as error:
            self.close()
            output = getattr(error, "output", None)
            reason = " ".join(output.split()) if output else str(error)
            raise SocketCanError(
                f"CAN interface {missing[0]} is missing and cannot be created ({reason}); type: {commands(missing)}"
            ) from None

    def _claim(self, names: Sequence[str]) -> None:
        """Keep other runs off: an abstract address per interface, which belongs to the network namespace as it does."""
        for name in names:
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._claims.append(claim)
            try:
                claim.bind(f"\0hume-hil/can/{name}")
            except OSError:
                self.close()
                raise SocketCanError(
                    f"another run uses the CAN interface {name}: give this one others with --interface {name}=…"
                ) from None

    @staticmethod
    def _ip(*arguments: str) -> None:
        subprocess.run(
            ["ip", *arguments], check=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    def close(self) -> None:
        """Remove what was created. A second call does nothing."""
        if self._remover is not None:
            self._remover.communicate()
            self._remover = None
        for claim in self._claims:
            claim.close()
        self._claims.clear()

    def __enter__(self) -> Interfaces:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class SocketCanPort:
    """A port on a SocketCAN interface, by python-can's stock ``socketcan`` interface.

    ``malformed`` counts frames that the emulation does not carry (error frames).
    """

    def __init__(self, channel: str) -> None:
        self.channel = channel
        try:
            self._bus = can.Bus(interface="socketcan", channel=channel, fd=True)
        except OSError as error:
            raise SocketCanError(f"CAN interface {channel} cannot be opened: {error.strerror}") from None
        self.malformed = 0

    def fileno(self) -> int:
        return self._bus.fileno()

    def send_frame(self, frame: Frame) -> None:
        """Hand ``frame`` to the kernel. Raises can.CanOperationError when it does not take it."""
        self._bus.send(to_message(frame, 0, self.channel))

    def send_error(self, error: ErrorFrame) -> None:
        """Show ``error`` to who asks for error frames on this interface (``candump -e``)."""
        identifier, data = error
        self._bus.send(
            can.Message(arbitration_id=identifier, is_extended_id=False, is_error_frame=True, dlc=len(data), data=data)
        )

    def take(self, count: int, timeout: float) -> list[Frame]:
        """The next ``count`` frames. Raises LostFramesError when one does not come for ``timeout`` seconds."""
        frames: list[Frame] = []
        for n in range(count):
            message = self._bus.recv(timeout)
            if message is None:
                raise LostFramesError(f"{self.channel}: {n} of {count} frames came through the kernel")
            self._append(message, frames)
        return frames

    def waiting(self) -> tuple[int, list[Frame]]:
        """Everything that waits, without waiting: how many frames, and those of them that are well formed."""
        frames: list[Frame] = []
        count = 0
        while (message := self._bus.recv(0)) is not None:
            count += 1
            self._append(message, frames)
        return count, frames

    def _append(self, message: can.Message, frames: list[Frame]) -> None:
        try:
            frames.append(to_frame(message))
        except can.CanOperationError:
            self.malformed += 1

    def shutdown(self) -> None:
        """Close the socket; processes that were forked meanwhile keep theirs."""
        self._bus.shutdown()
