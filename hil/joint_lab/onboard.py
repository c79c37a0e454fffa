"""A hydraulic joint's force loop on board its drive, and off board at the end of its bus (Rotella 2018 Fig. II.2).

The law is the same, ``joint_firmware.laws.valve``. On board the drive closes it at its interrupt rate, and the master
commands the torque. Off board the master closes it at its servo rate around the drive's reports, and commands the
valve in the drive's open-loop mode, with the delays that the bus gives it.

Both are tuned by one rule, each from its own sampled loop with the output locked: proportional and integral gain such
that the phase margin is ``PHASE_MARGIN``, with the integral's corner at a tenth of the crossover.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from bus.messages import Mode, Setpoint, State
from hil.errors import EmulationError
from hil.joint_lab import hydraulics, log, sampled
from hil.joint_lab.law import sampled_law
from hil.joint_lab.margins import Crossover, Response, frequencies, margins
from hil.joint_lab.master import Command
from hil.joint_lab.rig import Rig
from hil.joint_lab.setup import Setup, ratio
from hil.joint_lab.step import StepResponse
from joint_firmware.config import FirmwareConfig, TorqueGains
from joint_firmware.laws import TORQUE_LOOPS, Offsets, torque_loop_function
from plant.bench import Locked
from robots.description import Joint

PHASE_MARGIN = math.radians(50.0)
CORNER = 0.1  # of the integral, of the crossover
LAW = "valve"
_BOOT_S = 0.1
_LOW = 1.0  # rad/s
_WEAKEST, _STRIDE = 5e-2, 0.3  # where a gain is looked for, and in which steps of its logarithm
_PROBE_S = 0.05  # of commands, to see how late they act


class Loop(NamedTuple):
    """One way to close the force loop, tuned."""

    rate: float  # Hz
    delay: float  # s, from sensing to the valve's current
    gains: TorqueGains
    crossover: Crossover
    gain_margin: float


def tune(setup: Setup, rate: float, delay: float) -> Loop:
    """Gains of a loop that senses at ``rate`` Hz and acts ``delay`` s later, by the rule above."""
    joint, locked = setup.joint, Locked(at=f"{setup.load.at!r} rad")
    plant = sampled.discretise(hydraulics.state_space(joint, locked), 1.0 / rate, delay)

    def part(kp: float, ki: float) -> Response:
        firmware = _at_rate(setup.firmware, rate, TorqueGains(kp=kp, ki=ki))
        at_rest = firmware.model_copy(update={"valve_bias": 0.0})  # which moves the operating point and nothing else
        law = sampled_law(joint, at_rest, setup.gain_set, at=locked.at)
        return lambda omega: sampled.open_loop(plant, law, omega)

    parts = part(0.0, 0.0), part(1.0, 0.0), part(0.0, 1.0)  # the law is linear in its gains
    high = 0.999 * math.pi * rate
    omega = frequencies(_LOW, high)
    on_grid = [response(omega) for response in parts]

    def combined(kp: float, ki: float, values: Sequence[np.ndarray]) -> np.ndarray:
        neither, proportional, integral = values
        return neither + kp * (proportional - neither) + ki * (integral - neither)

    def with_corner(kp: float) -> tuple[float, float]:
        """Integral gain with its corner at its share of the crossover, which it hardly moves; the phase margin."""
        ki, margin = 0.0, math.inf
        for _ in range(4):
            found = _first_crossover(omega, combined(kp, ki, on_grid))
            if found is None:
                return 0.0, math.inf
            ki, margin = kp * CORNER * found.omega, found.phase_margin
        return ki, margin

    def excess(logarithm: float) -> float:
        return min(with_corner(math.exp(logarithm))[1], math.pi) - PHASE_MARGIN

    weak, strong = math.log(_WEAKEST), math.log(_WEAKEST) + _STRIDE
    while excess(strong) > 0.0:  # the first gain on the way up: beyond it, the phase may have gone round
        weak, strong = strong, strong + _STRIDE
    kp = math.exp(brentq(excess, weak, strong, xtol=1e-6))
    ki, _ = with_corner(kp)
    found = margins(lambda w: combined(kp, ki, [response(w) for response in parts]), _LOW, high)
    assert found.critical is not None  # there is the one that was looked for
    return Loop(rate, delay, TorqueGains(kp=kp, ki=ki), found.critical, found.gain_margin)


def _first_crossover(omega: np.ndarray, values: np.ndarray) -> Crossover | None:
    """Where the magnitude first falls below one, between the ``omega`` by interpolation in the logarithms."""
    size, phase = np.log(np.abs(values)), np.unwrap(np.angle(values))
    falling = np.flatnonzero((size[:-1] > 0.0) & (size[1:] <= 0.0))
    if not len(falling):
        return None
    i = falling[0]
    share = size[i] / (size[i] - size[i + 1])
    at = math.exp((1.0 - share) * math.log(omega[i]) + share * math.log(omega[i + 1]))
    return Crossover(at, math.remainder((1.0 - share) * phase[i] + share * phase[i + 1] + math.pi, 2.0 * math.pi))


def _at_rate(firmware: FirmwareConfig, rate: float, gains: TorqueGains) -> FirmwareConfig:
    return firmware.model_copy(update={"rate": rate, "law": LAW, "stance": gains, "swing": gains})


class OffBoard:
    """The force loop as a master closes it: ``command`` is asked once per servo tick with the drive's last report."""

    def __init__(self, joint: Joint, firmware: FirmwareConfig, servo_rate: float, gains: TorqueGains) -> None:
        loop, config = TORQUE_LOOPS[LAW], _at_rate(firmware, servo_rate, gains)
        values = loop.values(joint, config, Offsets())
        self._joint, self._function = joint, torque_loop_function(LAW)
        self._p = np.array([values[name] for name in loop.parameters])
        self._gains = np.array([gains.kp, gains.ki, gains.kd])
        self._x = np.zeros(len(loop.states))

    def effort(self, reference: float, state: State) -> float:
        """Effort of the valve [N m] for a torque of ``reference`` [N m] on the joint."""
        arm = ratio(self._joint, state.position)
        signals = (reference / arm, state.torque / arm, state.motor_velocity, state.motor_velocity)
        x, effort = self._function(signals, self._gains, self._x, self._p)
        self._x = np.array(x).ravel()
        return float(effort)

    def command(self, reference: Callable[[int], float]) -> Command:
        """Commands of the valve for the torque ``reference`` of servo ticks."""

        def of(tick: int, state: State) -> Setpoint:
            torque = self.effort(reference(tick), state) * ratio(self._joint, state.position)
            return Setpoint(mode=Mode.OPEN_LOOP, torque=torque)

        return of


def on_board(setup: Setup) -> Loop:
    """The drive's own loop: what it senses at an interrupt acts at the next one."""
    return tune(setup, setup.firmware.rate, setup.period + setup.timing.loop_delay)


def off_board(setup: Setup) -> Loop:
    """The master's loop: what is sensed with a report acts an interrupt after the command has come."""
    return tune(setup, setup.timing.servo_rate, (_offset(setup) + 1) * setup.period + setup.timing.loop_delay)


def _offset(setup: Setup) -> int:
    """Interrupts between a report and the one at which the command that answers it is read, as the bus shows."""
    with TemporaryDirectory() as scratch:
        rig = Rig(setup._replace(mode=Mode.OPEN_LOOP), setup.torque_command(lambda *_: 0.0), Path(scratch))
        rig.run(_BOOT_S + _PROBE_S)
        rig.recorder.close()
        exchange = _exchange(setup, Path(scratch))
    return log.pairs(exchange, int(setup.firmware.rate), setup.ticks_per_report).offset


def _exchange(setup: Setup, directory: Path) -> log.Exchange:
    path = directory / f"{setup.bus}.log"
    return log.read(path, setup.joint.node_id, setup.slot, int(setup.firmware.rate), setup.ticks_per_report)


class Exercise(NamedTuple):
    """What is commanded: nothing while the loop takes over, a sine, nothing, a step."""

    amplitude: float  # N m
    frequency: float  # Hz
    settle: float = 1.0  # s; a valve off its zero has let pressure build up before the drive is enabled
    periods: int = 3
    rest: float = 0.1  # s
    hold: float = 0.2  # s

    @property
    def sine_end(self) -> float:
        return self.settle + self.periods / self.frequency

    @property
    def step_at(self) -> float:
        return self.sine_end + self.rest

    @property
    def duration(self) -> float:
        return self.step_at + self.hold

    def torque(self, time: float) -> float:
        """N m, ``time`` s after the drive is enabled."""
        if self.settle <= time < self.sine_end:
            return self.amplitude * math.sin(2.0 * math.pi * self.frequency * (time - self.settle))
        return self.amplitude if time >= self.step_at else 0.0


class Tracking(NamedTuple):
    """Torque commanded and sensed, at the drive's reports."""

    seconds: np.ndarray  # (n,)
    commanded: np.ndarray  # (n,) N m
    sensed: np.ndarray  # (n,) N m

    @property
    def rms_error(self) -> float:
        """N m."""
        return float(np.sqrt(np.mean((self.sensed - self.commanded) ** 2)))

    @property
    def largest_error(self) -> float:
        """N m."""
        return float(np.abs(self.sensed - self.commanded).max())

    def sine(self, exercise: Exercise) -> Tracking:
        return self.between(exercise.settle, exercise.sine_end)

    def step(self, exercise: Exercise) -> StepResponse:
        part = self.between(exercise.step_at - exercise.rest / 2, exercise.duration)
        return StepResponse(part.seconds - exercise.step_at, part.sensed, exercise.amplitude)

    def between(self, start: float, end: float) -> Tracking:
        shown = (self.seconds >= start) & (self.seconds < end)
        return Tracking(self.seconds[shown], self.commanded[shown], self.sensed[shown])


def follow(
    setup: Setup, loop: Loop, boarded: bool, exercise: Exercise, directory: Path | None = None
) -> Tracking:
    """Go through ``exercise`` from when the drive is enabled, the loop on board if ``boarded``; log in ``directory``.

    Raises EmulationError when the drive does not bear it.
    """
    if directory is None:
        with TemporaryDirectory() as scratch:
            return follow(setup, loop, boarded, exercise, Path(scratch))
    servo = setup.timing.servo_rate

    def wanted(tick: int) -> float:
        return exercise.torque(tick / servo)

    if boarded:
        setup = setup._replace(firmware=_at_rate(setup.firmware, setup.firmware.rate, loop.gains))
        command = setup.torque_command(lambda tick, _: wanted(tick))
    else:
        command = OffBoard(setup.joint, setup.firmware, servo, loop.gains).command(wanted)
    rig = Rig(setup, command, directory)
    rig.run(_BOOT_S + exercise.duration)
    rig.recorder.close()
    if rig.master.failure is not None or rig.master.enabled_tick is None:
        raise EmulationError(f"the drive did not follow to the end: {rig.master.failure or 'it was never enabled'}")
    exchange = _exchange(setup, directory)
    start = setup.timing.servo_phase + (rig.master.enabled_tick - 1) / servo
    seconds = exchange.report_ticks / setup.firmware.rate - start
    shown = (seconds >= 0.0) & (seconds < exercise.duration)
    seconds = seconds[shown]
    return Tracking(seconds, np.array([exercise.torque(t) for t in seconds]), exchange.torques[shown])
