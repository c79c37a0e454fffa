"""Where does a run turn unstable? Bisects an injectable key: python docs/examples/find_boundary.py KEY LOW HIGH

LOW must be stable and HIGH unstable, both with their unit: link.command.delay 0ms 20ms. Every line is one run, in which
the value is injected once the robot stands (--at), so that what is found is the margin of standing, not of standing up.
"""

from __future__ import annotations

import argparse
import re

from hil.run import Request, run
from hil.scenario import load


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("key")
    parser.add_argument("low")
    parser.add_argument("high")
    parser.add_argument("--scenario", default="split-terrain")
    parser.add_argument("--at", default="5s", help="when the value is injected (5s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--steps", type=int, default=7)
    options = parser.parse_args()
    unit = re.sub(r"[-+.0-9e]", "", options.high)
    low, high = (float(text.removesuffix(unit)) for text in (options.low, options.high))
    print(f"{options.key:>20}   CoM error  internal force  foot slip  friction  pitch oscillation   verdict")
    for value in (low, high):
        stable = attempt(options, f"{value:g}{unit}")
        if stable != (value == low):
            found = "stable" if stable else "unstable"
            raise SystemExit(f"{options.key} = {value:g}{unit} is {found}: nothing to bisect")
    for _ in range(options.steps):
        middle = (low + high) / 2
        if attempt(options, f"{middle:.4g}{unit}"):
            low = middle
        else:
            high = middle
    print(f"stable up to {low:.4g}{unit}, unstable from {high:.4g}{unit} on")


def attempt(options: argparse.Namespace, value: str) -> bool:
    """One run, printed as a line. Returns whether it was stable."""
    injection = f'inject=[{{at="{options.at}", key="{options.key}", value="{value}"}}]'
    scenario = load(options.scenario, [*options.settings, injection])
    outcome = run(Request(scenario, seed=options.seed, backend="inline", report=False))
    metrics = outcome.record["metrics"]

    def show(name: str, scale: float, unit: str) -> str:
        number = metrics.get(name)
        return "      –      " if number is None else f"{scale * number:8.2f} {unit:4}"

    wave = metrics["oscillation"]["pitch"]
    swing = f"{1e3 * wave['amplitude']:6.1f} mrad {wave['frequency']:4.1f} Hz" if wave else "          –        "
    columns = [
        show("com_error_max", 1e3, "mm"), show("internal_force_error", 100, "%"), show("foot_slip_max", 1e3, "mm"),
        show("friction_used_max", 1, "of 1"), swing,
    ]  # fmt: skip
    print(f"{value:>20} {' '.join(columns)}   {outcome.record['reason']}", flush=True)
    return outcome.stable


if __name__ == "__main__":
    main()
