"""Frequency response of a drive through the emulation: sweeps in its commands, its reports, and what theory says.

Everything measured comes from the candump log of the bus: the torque commanded, the torque and the current reported.
From command and current the open loop follows without a model of the plant: with C the law's way from command to
current, which is known exactly since it is the drive's own arithmetic,

    current = C / (1 + L) · command      so      L = C command / current − 1

Commands are held, and reports made, at a lower rate than that of the drive's interrupts. What that adds at a frequency
are the images of higher ones, where the loop is so weak that the command passes as C lets it.
"""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from hil.errors import EmulationError
from hil.joint_lab import log, sampled
from hil.joint_lab.excitation import SIZES, Sweeps
from hil.joint_lab.identification import Measured, frequency_response
from hil.joint_lab.margins import Crossover
from hil.joint_lab.rig import Rig
from hil.joint_lab.setup import Setup

COHERENT = 0.9  # above it, a measured response is compared with theory
_BEYOND = 1.15  # the sweeps go so far beyond the frequencies that are looked at
_BOOT_S = 0.2  # at most, until the drive is enabled
_SHARE = 0.8  # of the drive's limits that a sweep may use


class Comparison(NamedTuple):
    """Measured and predicted response at the same frequencies, and their largest deviations where coherent."""

    measured: Measured
    predicted: np.ndarray

    @property
    def coherent(self) -> np.ndarray:
        return self.measured.coherence > COHERENT

    @property
    def magnitude_deviation(self) -> float:
        """Largest relative deviation of the magnitude."""
        ratio = np.abs(self.measured.values / self.predicted)[self.coherent]
        return float(np.abs(ratio - 1.0).max(initial=0.0))

    @property
    def phase_deviation(self) -> float:
        """rad."""
        angles = np.angle(self.measured.values / self.predicted)[self.coherent]
        return float(np.abs(angles).max(initial=0.0))


class Chirp(NamedTuple):
    """The outcome of one experiment."""

    torque: Comparison  # torque sensed over torque commanded
    current: Comparison  # current reported over torque commanded, A/(N m)
    loop: Comparison  # the open loop
    limited: float  # share of the reports in which an internal limit was active

    @property
    def crossovers(self) -> list[Crossover]:
        """Where the measured open loop, as far as it is coherent, crosses one: interpolated in the logarithms."""
        omega, values = self.loop.measured.omega, self.loop.measured.values
        size, phase = np.log(np.abs(values)), np.unwrap(np.angle(values))
        found = []
        sure = self.loop.coherent
        for i in np.flatnonzero(np.diff(np.sign(size)) * sure[:-1] * sure[1:]):
            share = size[i] / (size[i] - size[i + 1])
            w = math.exp((1 - share) * math.log(omega[i]) + share * math.log(omega[i + 1]))
            angle = (1 - share) * phase[i] + share * phase[i + 1] + math.pi
            found.append(Crossover(w, math.remainder(angle, 2 * math.pi)))
        return found


def amplitude(setup: Setup, high: float) -> float:
    """Of a sweep up to ``high`` Hz within the limits of torque, its rate, current and voltage of the drive, N m."""
    firmware, actuator = setup.firmware, setup.joint.actuator
    # commands come at the servo rate as steps, each of which the drive's rate limit must let pass within an interrupt
    steepest = 2.0 * math.sin(min(math.pi * high / setup.timing.servo_rate, math.pi / 2))
    omega = np.geomspace(1.0, 2.0 * math.pi * high, 300)
    closed = sampled.closed_loop(setup.plant(), setup.law())
    response = sampled.response(closed, np.exp(1j * omega * setup.period))[:, :, 0]
    current = response[:, -1] / actuator.torque_per_ampere
    bounds = [
        0.2 * firmware.torque_limit,
        firmware.torque_rate * setup.period / steepest,
        actuator.current_limit / float(np.abs(current).max()),
    ]
    if actuator.motor is not None:
        constant = actuator.torque_per_ampere / getattr(actuator, "efficiency", 1.0)  # V s/rad
        voltage = actuator.motor.resistance * current + constant * 1j * omega * response[:, 0]
        bounds.append(actuator.supply_voltage / float(np.abs(voltage).max()))
    return _SHARE * min(bounds)


def run(setup: Setup, sweeps: Sweeps, offset: float = 0.0, directory: Path | None = None) -> Chirp:
    """Sweep the drive's torque command around ``offset`` N m with a bus log in ``directory``, and compare with theory.

    Raises EmulationError when the drive does not bear it.
    """
    if directory is None:
        with TemporaryDirectory() as scratch:
            return run(setup, sweeps, offset, Path(scratch))
    rate = setup.timing.servo_rate
    excited = sweeps._replace(low=sweeps.low / _BEYOND, high=min(sweeps.high * _BEYOND, 0.45 * rate))
    samples = (offset + excited.samples(rate)).tolist()
    command = setup.torque_command(lambda tick, _: samples[tick] if tick < len(samples) else offset)
    rig = Rig(setup, command, directory)
    rig.run(_BOOT_S + len(samples) / rate)
    rig.recorder.close()
    if rig.master.failure is not None:
        raise EmulationError(f"the sweep ended early: {rig.master.failure}")
    return evaluate(setup, sweeps, directory / f"{setup.bus}.log")


def evaluate(setup: Setup, sweeps: Sweeps, path: Path) -> Chirp:
    """What the log at ``path`` tells of an experiment with ``sweeps``."""
    joint, rate, ratio = setup.joint, int(setup.firmware.rate), setup.ticks_per_report
    exchange = log.read(path, joint.node_id, setup.slot, rate, ratio)
    pairs = log.pairs(exchange, rate, ratio)
    period, rest = sweeps.period(pairs.rate), round(sweeps.rest * pairs.rate)
    offset = pairs.commanded[-1]  # the last rest's
    moving = np.flatnonzero(np.abs(pairs.commanded - offset) > 1e-3 * sweeps.amplitude)
    # windows begin in the middle of the rests, of which the first may still see the drive being enabled
    first = moving[0] - rest // 2
    windows = slice(first, first + len(SIZES) * period)
    u = pairs.commanded[windows]
    by_torque, by_current = (
        frequency_response(u, y[windows], pairs.rate, period, sweeps.low, sweeps.high)
        for y in (pairs.torques, pairs.currents)
    )
    theory = _Theory(setup, pairs.offset, by_torque.fine / pairs.rate)
    torque, current, direct, images, loop = map(by_torque.averaged, theory.responses())
    measured_loop = by_current._replace(values=direct / (by_current.values - images) - 1.0)
    return Chirp(
        Comparison(by_torque, torque),
        Comparison(by_current, current),
        Comparison(measured_loop, loop),
        float(np.mean(exchange.limited[exchange.report_ticks >= exchange.command_ticks[0]])),
    )


class _Theory:
    """What the setup's linear model says at ``angle``, rad per report (n,)."""

    def __init__(self, setup: Setup, offset: int, angle: np.ndarray) -> None:
        self._plant, self._law = setup.plant(), setup.law()
        self._stiffness, self._constant = setup.torque_per_sensed, setup.joint.actuator.torque_per_ampere
        self._ratio, self._offset, self._angle = setup.ticks_per_report, offset, angle

    def responses(self) -> tuple[np.ndarray, ...]:
        """Torque [N m] and current [A] reported over torque commanded, the two parts of ``_forward`` [A], the loop."""
        seen = sampled.at_reports(sampled.closed_loop(self._plant, self._law), self._ratio, self._offset)
        closed = sampled.response(seen, np.exp(1j * self._angle))[:, :, 0]
        direct, images = (part / self._constant for part in self._forward())
        loop = sampled.open_loop(self._plant, self._law, self._angle / (self._ratio * self._plant.period))
        return self._stiffness * closed[:, 1], closed[:, 2] / self._constant, direct, images, loop

    def _forward(self) -> tuple[np.ndarray, np.ndarray]:
        """From torque commanded to the motor torque that the current sensor sees, with the loop cut at the sensors:
        what comes of a command's own frequency, and of the images that the hold between two reports makes."""
        system = self._plant.system
        blind = system._replace(c=np.vstack([0.0 * system.c[:-1], system.c[-1:]]))
        whole = sampled.closed_loop(self._plant._replace(system=blind), self._law)
        parts = []
        for image in range(self._ratio):
            z = np.exp(1j * (self._angle + 2.0 * np.pi * image) / self._ratio)
            hold = sum(z**-k for k in range(self._offset, self._offset + self._ratio)) / self._ratio
            parts.append(hold * sampled.response(whole, z)[:, -2, 0])
        return parts[0], sum(parts[1:], np.zeros_like(parts[0]))
