"""``hil joint chirp``: frequency response of a joint's torque, measured through the emulated drive and its bus."""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from hil.commands.joint_arguments import seconds
from hil.commands.joint_lab_arguments import OPEN_LOOP, add_arguments, directory, laws_of, quantity, setup_of
from hil.errors import UserError

if TYPE_CHECKING:
    from hil.joint_lab.chirp import Chirp, Comparison
    from hil.joint_lab.setup import Setup


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "chirp", help="frequency response of a joint's torque through the emulated drive",
        description="Sweep the torque command of the emulated drive over its bus, identify the response from the bus's "
        "log alone, and lay it over theory (Kim 2018 Fig. 5.12). Dry friction is left out; "
        "--set world.friction_scale=1 puts it in.",
    )  # fmt: skip
    add_arguments(parser)
    parser.add_argument(
        "--law", default="all", metavar="LAW", help="PD_m, PD_m+DOB … or several with commas; open: none (all)"
    )
    parser.add_argument("--from", default="0.5Hz", metavar="HZ", dest="low", help="lowest frequency (0.5Hz)")
    parser.add_argument("--to", default="200Hz", metavar="HZ", dest="high", help="highest frequency (200Hz)")
    parser.add_argument("--amplitude", metavar="NM", help="of the torque, e.g. 5Nm (what the drive's limits allow)")
    parser.add_argument("--offset", default="0", metavar="NM", help="torque that the sweep is added to (0)")
    parser.add_argument("--duration", default="6s", metavar="S", help="of a sweep, of which there are four (6s)")
    parser.set_defaults(command=_chirp)


def _chirp(options: argparse.Namespace) -> int:
    from hil.joint_lab import chirp, plots
    from hil.joint_lab.excitation import Sweeps

    setup, out = setup_of(options, smooth=True), directory(options.out)
    low, high = quantity(options, "low", "--from", "Hz"), quantity(options, "high", "--to", "Hz")
    duration = seconds(options.duration)
    assert duration is not None
    if not 0 < low < high <= 0.4 * setup.firmware.report_rate:
        raise UserError(
            f"--from {options.low} --to {options.high}: expected them to rise, and to end below 0.4 of the report "
            f"rate, {0.4 * setup.firmware.report_rate:g} Hz"
        )
    if duration * low < 2:
        raise UserError(f"--duration {options.duration}: expected at least two periods of the lowest frequency")
    asked = None if options.amplitude is None else quantity(options, "amplitude", "--amplitude", "N m")
    offset = quantity(options, "offset", "--offset", "N m")
    found: dict[str, Chirp] = {}
    results: dict[str, dict[str, Any]] = {}
    for law, of_law in laws_of(options, setup, open_loop=True).items():
        try:
            size = chirp.amplitude(of_law, high) if asked is None else asked
            found[law] = chirp.run(
                of_law, Sweeps(low, high, duration, size), offset, None if out is None else out / law
            )
        except ValueError as error:
            raise UserError(str(error)) from None
        results[law] = _summary(found[law], size)
    if out is not None:
        title = f"{setup.robot.name} {setup.joint.name} at {setup.firmware.rate:g} Hz, load {options.load}"
        plots.responses(found, title, out / "chirp.png")
        closed = {law: chirp for law, chirp in found.items() if law != OPEN_LOOP}
        if closed:
            plots.measured_loops(closed, title, out / "chirp-loop.png")
    if options.json:
        print(json.dumps(results, allow_nan=False))
    else:
        _print(setup, options, results)
    return 0


def _summary(chirp: Chirp, amplitude: float) -> dict[str, Any]:
    from hil.joint_lab.margins import critical

    def deviations(comparison: Comparison) -> dict[str, float]:
        return {
            "coherent_share": float(comparison.coherent.mean()),
            "magnitude_deviation": comparison.magnitude_deviation,
            "phase_deviation_deg": math.degrees(comparison.phase_deviation),
        }

    at = critical(chirp.crossovers)
    return {
        "amplitude_nm": amplitude,
        "torque": deviations(chirp.torque),
        "current": deviations(chirp.current),
        "phase_margin_deg": None if at is None else math.degrees(at.phase_margin),
        "crossover_hz": None if at is None else at.omega / (2.0 * math.pi),
        "limited_share": chirp.limited,
    }


def _cell(part: dict[str, float]) -> str:
    if not part["coherent_share"]:
        return f"{'not measured':^28}"
    share = f"{100 * part['coherent_share']:.0f} %"
    return f"{100 * part['magnitude_deviation']:6.2f} % {part['phase_deviation_deg']:6.2f}° of {share:>6}"


def _print(setup: Setup, options: argparse.Namespace, results: dict[str, dict[str, Any]]) -> None:
    print(
        f"{setup.robot.name} {setup.joint.name}, load {options.load}, {setup.firmware.rate:g} Hz, friction × "
        f"{setup.friction_scale:g}; largest deviation from theory where coherence > 0.9"
    )
    print(f"{'law':10} {'amplitude':>10}   {'torque':^28}   {'current':^28}   open loop, measured")
    for law, part in results.items():
        cells = "   ".join(_cell(part[what]) for what in ("torque", "current"))
        margin = part["phase_margin_deg"]
        loop = "no crossover" if margin is None else f"{margin:.1f}° at {part['crossover_hz']:.1f} Hz"
        print(f"{law:10} {part['amplitude_nm']:6.2f} N m   {cells}   {loop}")
        if part["limited_share"] > 0.001:  # enabling the drive takes a report or two
            print(f"{'':10} limits were active in {100 * part['limited_share']:.1f} % of the reports: less --amplitude")
