"""``hil joint margins``: stability margins of a joint's torque loop, law by law."""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from hil.commands.joint_lab_arguments import add_arguments, directory, laws_of, setup_of
from hil.errors import UserError

if TYPE_CHECKING:
    from hil.joint_lab.analysis import Analysis
    from hil.joint_lab.setup import Setup

_RESOLUTION = 0.1  # of an interrupt's period: how closely --bisect brackets the delay
_KICK = 0.2  # of what a sweep may use


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "margins", help="stability margins of a joint's torque loop, law by law",
        description="Phase, gain and delay margins of the torque laws, in continuous time (Kim 2018 Fig. 5.10) and as "
        "the drive closes the loop: sampled, held, and one interrupt late. Dry friction is left out.",
    )  # fmt: skip
    add_arguments(parser)
    parser.add_argument("--law", default="all", metavar="LAW", help="PD_m, PD_f … or several with commas (all)")
    parser.add_argument(
        "--bisect", action="store_true", help="find the delay margin in the emulation, too, without dry friction"
    )
    parser.set_defaults(command=_margins)


def _margins(options: argparse.Namespace) -> int:
    from hil.joint_lab import analysis

    setup, out = setup_of(options), directory(options.out)
    found: dict[str, tuple[Analysis, Analysis]] = {}
    results: dict[str, dict[str, Any]] = {}
    for law, of_law in laws_of(options, setup).items():
        try:
            found[law] = analysis.in_continuous_time(of_law), analysis.as_sampled(of_law)
        except ValueError as error:
            raise UserError(str(error)) from None
        continuous, sampled = (part.summary() for part in found[law])
        if options.bisect:
            sampled["delay_margin_found_s"] = _bisect(of_law, found[law][1])
        results[law] = {**continuous, "sampled": sampled}
    if out is not None:
        _draw(setup, found, out)
    if options.json:
        print(json.dumps(results, allow_nan=False))
    else:
        _print(setup, options, results)
    return 0


def _bisect(setup: Setup, theory: Analysis) -> float | None:
    from hil.joint_lab import bisection, chirp

    critical = min(theory.margins.crossovers, key=lambda c: c.delay_margin, default=None)
    if critical is None or not theory.stable:
        return None
    smooth = setup._replace(friction_scale=0.0)
    kick = _KICK * chirp.amplitude(setup, critical.omega / (2.0 * math.pi))
    resolution = _RESOLUTION * setup.period
    try:
        return bisection.delay_margin(smooth, kick, critical.omega, critical.delay_margin, resolution)
    except ValueError:
        return None


def _draw(setup: Setup, found: dict[str, tuple[Analysis, Analysis]], out: Any) -> None:
    from hil.joint_lab import plots

    where = f"{setup.robot.name} {setup.joint.name}"
    for n, kind in enumerate(("continuous", "sampled")):
        curves = {law: both[n].curve for law, both in found.items() if both[n].stable}
        title = f"{where}, {kind}" + (f" at {setup.firmware.rate:g} Hz, one interrupt late" if n else " time")
        plots.bode(curves, title, out / f"bode-{kind}.png")
        plots.nyquist(curves, title, out / f"nyquist-{kind}.png")


def _print(setup: Setup, options: argparse.Namespace, results: dict[str, dict[str, Any]]) -> None:
    def number(value: float | None, digits: int, scale: float = 1.0) -> str:
        return "–" if value is None else f"{scale * value:.{digits}f}"

    def columns(part: dict[str, Any]) -> str:
        if not part["stable"]:
            return f"{'unstable':>37}"
        return (
            f"{number(part['phase_margin_deg'], 1):>7}° {number(part['crossover_hz'], 1):>6} Hz "
            f"{number(part['gain_margin_db'], 1):>6} dB {number(part['delay_margin_s'], 2, 1e3):>6} ms"
        )

    def passive(part: dict[str, Any]) -> str:
        if part["passive"] is None:
            return "–"
        return "passive" if part["passive"] else f"active from {part['active_from_hz']:.3g} Hz"

    print(f"{setup.robot.name} {setup.joint.name}, load {options.load}, without dry friction")
    print(f"{'':10} {'continuous time':^37}   sampled at {setup.firmware.rate:g} Hz, one interrupt late")
    head = f"{'phase':>8} {'crossover':>9} {'gain':>9} {'delay':>9}"
    print(f"{'law':10} {head:37}   {head:37}   output impedance (continuous; sampled)")
    for law, part in results.items():
        sampled = part["sampled"]
        line = f"{law:10} {columns(part)}   {columns(sampled)}   {passive(part)}; {passive(sampled)}"
        print(line)
        if "delay_margin_found_s" in sampled and sampled["stable"]:
            late = f"{number(sampled['delay_margin_found_s'], 3, 1e3)} ms"
            print(f"{'':10} delay margin predicted {number(sampled['delay_margin_s'], 3, 1e3)} ms, by bisection {late}")
