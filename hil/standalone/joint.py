"""One emulated joint on any python-can bus: the firmware, its actuator on a bench, in wall-clock time."""

from __future__ import annotations

from typing import Any

import can

from bus import messages
from bus.can_messages import to_frame, to_message
from bus.frames import Frame
from bus.messages import Controlword, Setpoint
from hil.clock import WallClock, tick_ns
from hil.errors import EmulationError, UserError
from joint_firmware.firmware import JointFirmware
from plant.bench import Bench


def open_bus(where: str) -> can.BusABC:
    """The python-can bus ``INTERFACE:CHANNEL``. Raises UserError with the reason."""
    interface, separator, channel = where.partition(":")
    if not separator or not interface or not channel:
        raise UserError(f"--can {where}: expected INTERFACE:CHANNEL, for example hil:lab or socketcan:can0")
    try:
        return can.Bus(interface=interface, channel=channel, fd=True)
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
        raise UserError(f"--can {where}: {' '.join(str(error).split())}") from None


class StandaloneJoint:
    """Calls the firmware at its interrupt rate, with what has come over ``bus``, and steps its bench.

    What the bus does not take at once is dropped, as by a full transmit buffer.
    """

    def __init__(self, firmware: JointFirmware, bench: Bench, bus: can.BusABC, rate: int, steps: int) -> None:
        firmware.attach(bench.pins_in, bench.pins_out)
        self.firmware, self.bench, self.bus = firmware, bench, bus
        self.clock = WallClock(round(1e9 / rate))
        self.sent = 0
        self.dropped = 0  # not taken by the bus
        self.received = 0
        self.ignored = 0  # what python-can gave and no firmware could be given
        self._rate, self._steps = rate, steps
        self._tick = 0
        self._stopped = False

    def stop(self) -> None:
        """Let ``run`` come to its end; a signal handler may call it."""
        self._stopped = True

    def run(self, duration: float | None) -> None:
        """Run for ``duration`` s or until stopped, then switch the drive off and report that.

        Raises EmulationError when the bus has gone.
        """
        last = None if duration is None else round(duration * self._rate)
        self.clock.start()
        while not self._stopped and (last is None or self._tick < last):
            now = tick_ns(self._tick, self._rate)
            self.clock.wait_until(now)
            self._interrupt(now, self._receive())
        self._switch_off()

    def _interrupt(self, now: int, frames: list[Frame]) -> list[Frame]:
        """One tick of firmware and bench, in the order of ``hil.system``."""
        bench = self.bench
        bench.sample()
        bench.latch()
        sent = self.firmware.tick(now, frames)
        for _ in range(self._steps):
            bench.step()
        for frame in sent:
            self._send(frame)
        self._tick += 1
        return sent

    def _switch_off(self) -> None:
        """What an operator's "disable voltage" does, up to the report that says so."""
        counter = (self.firmware.snapshot()["_command_counter"] or 0) + 1
        off = messages.encode_command(counter, [Setpoint(Controlword.DISABLE_VOLTAGE)] * messages.SLOTS)
        frames = [Frame(messages.COMMAND, off)]
        state = messages.STATE + self.firmware.node_id
        for _ in range(self._rate):  # at most a second
            now = tick_ns(self._tick, self._rate)
            if any(frame.id == state for frame in self._interrupt(now, frames)):
                break
            frames = []
        self.bench.latch()

    def _receive(self) -> list[Frame]:
        frames = []
        try:
            while (message := self.bus.recv(0.0)) is not None:
                self.received += 1
                try:
                    frames.append(to_frame(message))
                except can.CanOperationError:
                    self.ignored += 1
        except (can.CanError, OSError) as error:
            raise EmulationError(f"{self.bus.channel_info}: {error}") from None
        return frames

    def _send(self, frame: Frame) -> None:
        try:
            self.bus.send(to_message(frame, 0, ""), 0.0)
            self.sent += 1
        except (can.CanError, OSError):
            self.dropped += 1

    def report(self) -> dict[str, Any]:
        """How it went, in wall-clock terms."""
        counts = {key: getattr(self, key) for key in ("sent", "dropped", "received", "ignored")}
        return {
            "joint": self.firmware.name,
            "node": self.firmware.node_id,
            "ticks": self._tick,
            "state": self.firmware.state.name,
            **counts,
            "malformed": self.firmware.malformed,
            "wall_clock": self.clock.report(),
        }
