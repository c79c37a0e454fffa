"""What ends a standing robot with stiff tasks, friction or noise; and what the size of displacements does to its linear
loop (docs/studies/bandwidth.md)."""

from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.quantity import quantity
from hil.lab.transplant import Standing
from hil.scenario import load
from hil.studies.bandwidth import ALONE, TASK, TORQUE

PLACES = (
    (0.25, 1.5),
    (0.25, 2.0),
    (1.0, 2.0),
    (2.0, 2.0),
    (4.0, 2.0),
)  # gain of the torque loops, bandwidth of the tasks


def main() -> None:
    nominal = load("stand", ["duration=6s", *ALONE])
    torque, task = quantity(nominal, TORQUE), quantity(nominal, TASK)
    for setting in ("sensors.noise=0", "world.friction_scale=0"):
        standing = Standing(load("stand", ["duration=6s", *ALONE, setting]), 0, 2.5)
        for gain, bandwidth in PLACES:
            print(f"{setting:24} ×{gain:<5g}×{bandwidth:<4g}", standing.outcome({torque: gain, task: bandwidth}).reason)
    with (
        OperatingPoint(nominal, 4.0) as home, home.elsewhere(torque, 2.0) as detuned,
        detuned.elsewhere(task, 2.0) as stiff,
    ):  # fmt: skip
        for scale in (1.0, 0.5, 0.25, 0.1):
            loop = stiff.linearise(scale=scale)
            print(f"×2 ×2, displacements ×{scale:<5g} noise {loop.noise:<8.2g} dominant {loop.growth:.1f}/s")


if __name__ == "__main__":
    main()
