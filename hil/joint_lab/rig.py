"""One drive, its actuator on a bench, a bus with its bit timing and a master, in virtual time.

What happens at one instant happens in the calendar's order: wire, drive, master's tick, master's answer. So a rig is as
reproducible as a run.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from bus.config import BusConfig
from bus.frames import Frame
from bus.link import NEVER
from bus.wire import Wire
from hil.clock import tick_ns
from hil.joint_lab.master import Command, Master
from hil.joint_lab.setup import Setup
from hil.record.recorder import Recorder
from hil.streams import streams
from joint_firmware.firmware import JointFirmware
from plant.bench import Bench
from robots import pins

TRUTH = "/bench"  # channel of what the bench knows, at every interrupt
SIGNALS = ("position", "velocity", "spring_torque")  # rad, rad/s, N m
_DRIVE, _MASTER = 0, 1  # ports of the wire


class Rig:
    """Runs one joint over its bus; every frame goes into ``recorder``'s candump log.

    The timing's ``loop_delay`` lets the drive's outputs take effect later than at its next interrupt: it delays the
    loop that the drive closes and nothing else.
    """

    def __init__(self, setup: Setup, command: Command, directory: Path | None = None) -> None:
        """Powered on. Raises ValueError for a load too light for the physics' rate."""
        robot, index, firmware, timing = setup.robot, setup.joint_index, setup.firmware, setup.timing
        random = streams(setup.seed)
        self._rate, self._steps = int(firmware.rate), round(timing.physics_rate / firmware.rate)
        self.firmware = JointFirmware(robot, index, firmware, setup.compile)
        self.bench = Bench(
            robot, index, setup.load, timing.physics_rate, setup.sensors, random, setup.friction_scale, setup.compile
        )
        self.master = Master(robot, index, command)
        self.wire = Wire(setup.bus, BusConfig(), 2, random)
        self.recorder = Recorder(directory, {TRUTH: SIGNALS}, [setup.bus])
        self._truth, self._row = self.recorder.channel(TRUTH), np.zeros(len(SIGNALS))
        self._outputs = np.zeros(pins.N_OUTPUTS, np.int32)
        self.firmware.attach(self.bench.pins_in, self._outputs)
        # outputs on their way, by the number of the physics step from which they act
        self._underway: deque[tuple[int, list[int]]] = deque()
        self._lag = self._steps + round(timing.loop_delay * timing.physics_rate)
        self._inbox: list[Frame] = []
        self._tick = self._servo_tick = 0
        self._servo_rate, self._phase_ns = int(timing.servo_rate), round(timing.servo_phase * 1e9)
        self._command_delay_ns = round(timing.command_delay * 1e9)
        self._commands: deque[tuple[int, Frame]] = deque()

    def run(self, seconds: float) -> None:
        """Go on up to ``seconds`` of virtual time since power-on."""
        end = round(seconds * 1e9)
        while True:
            drive, servo = tick_ns(self._tick, self._rate), self._phase_ns + tick_ns(self._servo_tick, self._servo_rate)
            answer = self._commands[0][0] if self._commands else NEVER
            now = min(self.wire.next_ns, drive, servo, answer)
            if now >= end:
                break
            if self.wire.next_ns <= now:
                self._deliver(now)
            if drive == now:
                self._interrupt(now)
            if servo == now:
                self._servo_tick += 1
                command = self.master.tick()
                if command is not None:
                    self._commands.append((now + self._command_delay_ns, command))
            while self._commands and self._commands[0][0] <= now:
                self.wire.offer(now, _MASTER, self._commands.popleft()[1])
        self.recorder.flush(end)

    def _deliver(self, now: int) -> None:
        for time, sender, frame, _ in self.wire.advance(now):
            self.recorder.frame(time, 0, frame)
            if sender == _DRIVE:
                self.master.receive(frame)
            else:
                self._inbox.append(frame)

    def _interrupt(self, now: int) -> None:
        bench, step = self.bench, self._tick * self._steps
        bench.sample()
        self._row[:] = bench.position, bench.velocity, bench.spring_torque
        self._truth.append(now, self._row)
        sent = self.firmware.tick(now, self._inbox)
        self._inbox = []
        self._underway.append((step + self._lag, self._outputs.tolist()))
        for number in range(step, step + self._steps):
            while self._underway and self._underway[0][0] <= number:
                bench.pins_out[:] = self._underway.popleft()[1]
                bench.latch()
            bench.step()
        self._tick += 1
        for frame in sent:
            self.wire.offer(now, _DRIVE, frame)
