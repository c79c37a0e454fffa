"""``hil gait``: is walking by constant time to velocity reversal stable with these parameters, and which would be?"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, UserError

if TYPE_CHECKING:  # the command line starts without it
    from central_controller.planning.gait import Gait

_BIAS = 0.01  # m, for which the width of the lateral limit cycle is told


def add_parser(commands: Any) -> None:
    """The subcommand ``gait``."""
    parser = commands.add_parser(
        "gait",
        help="stability of the foot placement from step to step, and its design",
        description="Eigenvalues from step to step of foot placement by constant time to velocity reversal on level "
        "ground (Kim 2018 §4.3.2). Exit status 0: stable, 1: not.",
    )
    parser.add_argument("--height", default="0.86m", metavar="M", help="of the centre of mass above the feet (0.86m)")
    parser.add_argument("--step-time", metavar="S", help="from one change of the stance foot to the next (0.335s)")
    parser.add_argument("--kappa", type=float, metavar="K", help="pull towards the goal (0.4)")
    parser.add_argument("--reversal-time", metavar="S", help="t', from the change to zero velocity (0.185s)")
    parser.add_argument(
        "--design", type=float, metavar="MAGNITUDE",
        help="find t' and kappa for eigenvalues of ± this magnitude; with --kappa: t' alone, for the greater one",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="DIR", help="write gait-map.png and gait-portrait.png there")
    parser.add_argument("--json", action="store_true", help="print one JSON object, SI units")
    parser.set_defaults(command=_gait)


def _gait(options: argparse.Namespace) -> int:
    gait = _asked(options)
    answer = describe(gait)
    if options.out is not None:
        from hil.commands.joint_lab_arguments import directory
        from hil.report import gait_plots

        out = directory(options.out)
        assert out is not None
        gait_plots.stability_map(gait, out / "gait-map.png")
        gait_plots.portrait(gait, out / "gait-portrait.png")
        answer["written"] = [str(out / name) for name in ("gait-map.png", "gait-portrait.png")]
    if options.json:
        print(json.dumps(answer, allow_nan=False))
    else:
        _print(gait, answer)
    return EXIT_STABLE if answer["stable"] else EXIT_UNSTABLE


def _asked(options: argparse.Namespace) -> Gait:
    """The gait that the options tell of, designed if they want it. Raises UserError."""
    from central_controller.planning import gait as analysis
    from central_controller.planning.config import PlannerConfig, StepTiming

    planner = PlannerConfig()
    kappa = planner.kappa_x if options.kappa is None else options.kappa
    if not (math.isfinite(kappa) and abs(kappa) <= 100.0):
        raise UserError(f"--kappa {kappa:g}: expected a number from -100 to 100")
    gait = analysis.Gait(
        _quantity("--height", options.height, "m", 0.01, 100.0),
        _quantity("--step-time", options.step_time, "s", 1e-3, 10.0) or StepTiming().step_time,
        kappa,
        _quantity("--reversal-time", options.reversal_time, "s", 1e-3, 10.0) or planner.reversal_time_x,
    )
    wanted = options.design
    if wanted is None:
        return gait
    if options.reversal_time is not None:
        raise UserError("--design and --reversal-time exclude each other: the design finds it")
    if not 0.0 <= wanted < 1.0:
        raise UserError(f"--design {wanted:g}: expected a magnitude from 0 to below 1; at 1 nothing dies away")
    try:
        if options.kappa is None:
            return analysis.place(gait.height, gait.step_time, wanted, -wanted)
        return analysis.with_magnitude(gait, wanted)
    except ValueError as error:
        raise UserError(f"--design {wanted:g}: {error}") from None


def _quantity(option: str, text: str | None, unit: str, low: float, high: float) -> float:
    """The value of ``option``; 0 when it was not given. Raises UserError."""
    from robots.quantities import parse_quantity

    if text is None:
        return 0.0
    try:
        value = parse_quantity(text, unit)
    except ValueError as error:
        raise UserError(f"{option}: {error}") from None
    if not low <= value <= high:
        raise UserError(f"{option} {text}: expected {low:g} {unit} to {high:g} {unit}")
    return value


def describe(gait: Gait) -> dict[str, Any]:
    """What there is to tell of a gait, for JSON: SI units, complex numbers as [real, imaginary]."""
    low, high = gait.stable_reversal_times()
    possible = gait.kappa > 0.0 and low < high
    stable = gait.magnitude < 1.0
    return {
        "height": gait.height,
        "step_time": gait.step_time,
        "kappa": gait.kappa,
        "reversal_time": gait.reversal_time,
        "omega": gait.omega,
        "step_map": gait.step_map().tolist(),
        "eigenvalues": [[float(value.real), float(value.imag)] for value in gait.eigenvalues()],
        "magnitude": float(gait.magnitude),
        "stable": bool(stable),
        "stable_reversal_times": [low, high if math.isfinite(high) else None] if possible else None,
        "step_width_per_bias": gait.step_width(1.0) if stable else None,
    }


def _print(gait: Gait, answer: dict[str, Any]) -> None:
    def text(value: list[float]) -> str:
        real, imaginary = value
        return f"{real:+.3f}" if imaginary == 0.0 else f"{real:+.3f}{imaginary:+.3f}i"

    print(
        f"centre of mass {gait.height:g} m high, {gait.step_time:g} s per step, kappa {gait.kappa:.4g}, "
        f"velocity reversal after {gait.reversal_time:.4g} s"
    )
    verdict = "stable" if answer["stable"] else "NOT stable"
    print(f"eigenvalues from step to step {', '.join(map(text, answer['eigenvalues']))}: {verdict}")
    if answer["stable"]:
        half = math.inf if gait.magnitude == 0.0 else math.log(0.5) / math.log(gait.magnitude)
        print(f"a disturbance is halved in {half:.1f} steps" if math.isfinite(half) else "gone after two steps")
        width = replace(gait).step_width(_BIAS)
        print(f"feet put {100 * _BIAS:g} cm further out than planned come to stand {100 * width:.1f} cm apart")
    times = answer["stable_reversal_times"]
    if gait.kappa <= 0.0:
        print("no reversal time is stable: kappa must be above 0")
    elif times is None:
        print("no reversal time is stable: kappa is too great for this step time")
    else:
        low, high = times
        print(f"stable with reversal times from {low:.4g} s" + (f" to {high:.4g} s" if high is not None else " on"))
