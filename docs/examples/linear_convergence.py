"""How the modes of the linearised loop depend on the size of the displacements.

python docs/examples/linear_convergence.py
"""

from __future__ import annotations

from hil.lab.linear.operating_point import OperatingPoint
from hil.scenario import load

_SCALES = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
_WAVES = 4


def main() -> None:
    with OperatingPoint(load("split-terrain"), 5.0) as point:
        values = {"link.command.delay": 4e-3}
        reference = point.linearise(values)
        waves = [mode for mode in reference.modes if mode.frequency > 0.5][:_WAVES]
        print("scale    noise  " + "".join(f"{mode.shares[0][0]:>24}" for mode in waves))
        for scale in _SCALES:
            found = point.linearise(values, scale)
            cells = [f"{m.growth:.2f}/s {m.frequency:.3f} Hz" for m in (found.like(wave) for wave in waves)]
            print(f"{scale:5g}  {found.noise:.1e}  " + "".join(f"{cell:>24}" for cell in cells))


if __name__ == "__main__":
    main()
