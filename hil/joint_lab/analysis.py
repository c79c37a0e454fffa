"""What theory says of one joint under one law: margins in continuous time and as sampled, and passivity."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from hil.joint_lab import continuous, impedance, sampled
from hil.joint_lab.impedance import Passivity
from hil.joint_lab.law import gains_of
from hil.joint_lab.margins import Margins, frequencies, margins
from hil.joint_lab.plots import Curve
from hil.joint_lab.sampled import SampledLaw, SampledPlant, discretise
from hil.joint_lab.setup import Setup

LOW, HIGH = 0.1, 1e5  # rad/s: where margins are looked for
_FAST = 1e6  # Hz
_BELOW = 0.999  # of the Nyquist frequency
_STABLE = 1.0 + 1e-6  # a free output's position and unused integrators are at one, up to rounding


class Analysis(NamedTuple):
    """Of a loop: margins mean something only if it is stable when closed."""

    stable: bool
    curve: Curve
    passivity: Passivity | None  # of a hydraulic joint it is not looked at

    @property
    def margins(self) -> Margins:
        return self.curve.margins

    def summary(self) -> dict[str, Any]:
        """Numbers for a person or ``--json``; None where there is no crossover, and of an unstable loop no margins."""
        found, passive = self.margins, self.passivity
        critical = found.critical if self.stable else None

        def finite(value: float) -> float | None:
            return value if self.stable and math.isfinite(value) else None

        return {
            "phase_margin_deg": None if critical is None else math.degrees(critical.phase_margin),
            "crossover_hz": None if critical is None else critical.omega / (2.0 * math.pi),
            "gain_margin_db": finite(20.0 * math.log10(found.gain_margin)),
            "delay_margin_s": finite(found.delay_margin),
            "stable": self.stable,
            "passive": None if passive is None else passive.passive,
            "active_from_hz": None if passive is None else passive.from_hz,
            "most_active_hz": None if passive is None else passive.worst_hz,
        }


def in_continuous_time(setup: Setup) -> Analysis:
    """As the source has it: without delay, without sampling. Raises ValueError for a load that is not linear."""
    if setup.hydraulic:  # its law is in the source as words: the implemented one, hardly sampled
        fast = setup.firmware.model_copy(update={"rate": _FAST, "report_rate": _FAST})
        often = setup._replace(firmware=fast)
        return _of_samples(discretise(often.model(), often.period, 0.0), often.law(), HIGH, None)
    actuator, gains, law = setup.actuator(), gains_of(setup.joint, setup.firmware, setup.gain_set), setup.firmware.law
    rational = continuous.open_loop(law, actuator, gains)
    curve = _curve(lambda omega: rational(1j * omega), HIGH)
    omega = frequencies(LOW, HIGH)
    stable = bool((rational.closed_loop_poles().real < 1e-9).all())
    return Analysis(stable, curve, impedance.passivity(omega, impedance.continuous(law, actuator, gains, omega)))


def as_sampled(setup: Setup) -> Analysis:
    """As the drive closes it: the law at its interrupts, its output held from the next one on.

    Raises ValueError for a load that is not linear.
    """
    plant, law, high = setup.plant(), setup.law(), _BELOW * setup.nyquist
    if setup.hydraulic:
        return _of_samples(plant, law, high, None)
    omega = frequencies(LOW, high)
    shaken = impedance.sampled(law, setup.actuator(), setup.period + setup.timing.loop_delay, omega)
    return _of_samples(plant, law, high, impedance.passivity(omega, shaken))


def _of_samples(plant: SampledPlant, law: SampledLaw, high: float, passivity: Passivity | None) -> Analysis:
    curve = _curve(lambda omega: sampled.open_loop(plant, law, omega), high)
    return Analysis(sampled.spectral_radius(plant, law) < _STABLE, curve, passivity)


def _curve(loop: Any, high: float) -> Curve:
    return Curve(loop, margins(loop, LOW, high), LOW, high)
