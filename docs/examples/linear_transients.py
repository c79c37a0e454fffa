"""Modes of the linearised loop beside what a small transient of the emulation does.

    python docs/examples/linear_transients.py

At several delays of the commands a rotor is displaced by 1 mrad, without dry friction, noise and rounding as in the
linearisation, and the internal force between the feet is logged for half a second: the sum of damped waves that fits it
has the frequency and growth of the mode, or the linearisation is wrong.
"""

from __future__ import annotations

import numpy as np

from hil.analysis.damped_waves import Wave, damped_waves
from hil.lab.linear.operating_point import OperatingPoint
from hil.scenario import load

_DELAYS = (0.0, 2e-3, 4e-3, 6e-3, 8e-3, 10e-3)
_PERIODS, _SKIPPED, _THINNED = 750, 60, 4


def force_wave(point: OperatingPoint, delay: float) -> Wave:
    """The largest wave between 10 Hz and 30 Hz of the internal force."""
    section = point.section({"link.command.delay": delay})
    world = point.system.world
    column = world.truth_fields.index("internal_force")
    step = np.zeros(len(section.names))
    step[section.names.index("left_hip rotor")] = 1e-3
    logs = np.zeros((2, _PERIODS))
    for log, by in zip(logs, (step, -step), strict=True):
        section.displace(by)
        for k in range(_PERIODS):
            section.advance()
            log[k] = world.truth()[column]
    force = (logs[0] - logs[1])[_SKIPPED::_THINNED]
    return next(wave for wave in damped_waves(force, _THINNED * section.period) if 10 < wave.frequency < 30)


def main() -> None:
    for scenario in ("stand", "split-terrain"):
        with OperatingPoint(load(scenario), 3.0) as point:
            print(f"{scenario:>13}   predicted            in the emulation")
            for delay in _DELAYS:
                found = point.linearise({"link.command.delay": delay})
                wave = force_wave(point, delay)
                mode = min(
                    (m for m in found.modes if m.frequency > 1),
                    key=lambda m: abs(complex(m.growth - wave.growth, 2 * np.pi * (m.frequency - wave.frequency))),
                )
                print(
                    f"{1e3 * delay:>10g} ms   {mode.growth:>7.2f}/s {mode.frequency:>6.2f} Hz   "
                    f"{wave.growth:>7.2f}/s {wave.frequency:>6.2f} Hz"
                )


if __name__ == "__main__":
    main()
