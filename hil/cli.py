"""The command ``hil``.

Exit status: 0 stable, 1 unstable, 2 a mistake of the user's, 3 the emulation failed (or was ended by a signal).
"""

from __future__ import annotations

import os

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # 12 × 12 matrices: threads only cost, and children are forked

import argparse  # noqa: E402
import json  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any, NoReturn  # noqa: E402

from hil.errors import EXIT_EMULATION, EXIT_USER, HilError, UserError  # noqa: E402


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (`{self.prog} --help` lists what there is)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status."""
    try:
        options = _parser().parse_args(arguments)
        return options.command(options)
    except HilError as error:
        print(f"hil: {error}", file=sys.stderr)
        return error.exit_status
    except BrokenPipeError:
        return EXIT_EMULATION
    except KeyboardInterrupt:
        return EXIT_EMULATION


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="hil", description="Hardware-in-the-loop style emulation of legged robots.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser("run", help="run a scenario to its verdict")
    run.add_argument("scenario", metavar="SCENARIO", help="a built-in scenario or the path of a .toml file")
    run.add_argument("--seed", type=_natural, default=0, metavar="N")
    run.add_argument("--duration", metavar="S", help="simulated time, e.g. 5s")
    run.add_argument("--backend", choices=("processes", "inline"), default="processes")
    run.add_argument("--clock", choices=("virtual", "wall"), default="virtual")
    run.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    run.add_argument("--out", type=Path, metavar="DIR", help="directory of the record (default: runs/…)")
    run.add_argument("--zenoh", metavar="tcp/HOST:PORT", help="join this Zenoh router instead of a private session")
    run.add_argument("--video", action="store_true", help="also write video.mp4")
    run.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    run.set_defaults(command=_run)

    scenarios = commands.add_parser("scenarios", help="list the built-in scenarios")
    scenarios.add_argument("--json", action="store_true")
    scenarios.set_defaults(command=_scenarios)

    bench = commands.add_parser("bench", help="measure speed, memory and start-up on this machine")
    bench.add_argument("--duration", metavar="S", default="5s", help="simulated time of each measurement")
    bench.add_argument("--json", action="store_true")
    bench.set_defaults(command=_bench)

    inject = commands.add_parser("inject", help="change an impairment of a run that is going on")
    inject.add_argument("key", nargs="?", metavar="KEY", help="e.g. link.command.delay")
    inject.add_argument("value", nargs="?", metavar="VALUE", help="with its unit, e.g. 3ms")
    inject.add_argument("--run", metavar="NAME", help="which run, when several are going on")
    inject.add_argument("--list", action="store_true", help="list the keys")
    inject.set_defaults(command=_inject)
    return parser


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is negative: expected 0, 1, 2 …")
    return value


def _run(options: argparse.Namespace) -> int:
    from hil.run import Request, run
    from hil.scenario import load

    settings = list(options.settings)
    if options.duration is not None:
        unit = "" if options.duration.strip()[-1:].isalpha() else "s"
        settings.append(f"duration={options.duration}{unit}")
    scenario = load(options.scenario, settings)
    if options.zenoh is not None and options.backend == "inline":
        raise UserError("--zenoh has no meaning with --backend inline: nothing goes through Zenoh there")
    out = options.out or Path("runs") / f"{scenario.name}-seed{options.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    if (out / "run.json").exists():
        raise UserError(f"--out {out}: holds the record of another run; name a new directory")
    request = Request(
        scenario, options.seed, options.backend, options.clock, out, video=options.video, zenoh=options.zenoh
    )
    from hil.control import serve_run

    if options.json:
        outcome = run(request, prepare=serve_run)
        print(json.dumps(outcome.record, allow_nan=False))
        return outcome.exit_status
    from hil.progress import Display

    with Display(scenario, sys.stderr) as display:
        outcome = run(request, display.update, prepare=serve_run)
    _print_outcome(outcome.record)
    return outcome.exit_status


def _print_outcome(record: dict[str, Any]) -> None:
    metrics = record["metrics"]

    def number(key: str, scale: float, unit: str, digits: int = 1) -> str:
        value = metrics.get(key)
        return "–" if value is None else f"{value * scale:.{digits}f} {unit}"

    print(f"{record['scenario']}, seed {record['seed']}, {record['backend']}, {record['clock']} clock")
    print(f"verdict     {record['verdict']}: {record['reason']}")
    print(f"simulated   {record['simulated_time']:.2f} s at {record['realtime_factor']:.2f} × real time")
    print(f"CoM error   max {number('com_error_max', 1e3, 'mm')}, rms {number('com_error_rms', 1e3, 'mm')}")
    if metrics.get("internal_force_error") is not None:
        print(
            f"int. force  error {number('internal_force_error', 100, '%')} sensed, "
            f"{number('internal_force_error_truth', 100, '%')} true"
        )
    print(f"round trip  p50 {number('round_trip_p50', 1e3, 'ms', 3)}, p99 {number('round_trip_p99', 1e3, 'ms', 3)}")
    load = metrics.get("bus_load") or {}
    print("bus load    " + ", ".join(f"{bus} {100 * value:.0f} %" for bus, value in load.items()))
    wall = record["wall_clock"]
    if wall is not None:
        print(f"deadlines   {100 * wall['missed_share']:.2f} % missed, scheduling {wall['scheduling']}")
        for bin_, count in wall["histogram"].items():
            if count:
                print(f"            {bin_:>24}: {count}")
        if not wall["kept_up"]:
            print("            this machine does NOT keep up at these rates: lower firmware.rate and controller.rate")
    print(f"digest      {record['log_digest']}")
    if record["out"] is not None:
        report = Path(record["out"]) / "report.html"
        print(f"report      {report if report.exists() else record['out']}")


def _scenarios(options: argparse.Namespace) -> int:
    from hil.scenario import builtin_names, load

    loaded = [load(name) for name in builtin_names()]
    if options.json:
        print(json.dumps([{"name": s.name, "duration": s.duration, "description": s.description} for s in loaded]))
        return 0
    for scenario in loaded:
        print(f"{scenario.name:22} {scenario.duration:5.1f} s  {scenario.description}")
    return 0


def _bench(options: argparse.Namespace) -> int:
    from hil.bench import bench
    from robots.quantities import parse_quantity

    try:
        duration = parse_quantity(options.duration, "s")
    except ValueError as error:
        raise UserError(f"--duration: {error}") from None
    return bench(duration, as_json=options.json)


def _inject(options: argparse.Namespace) -> int:
    from hil import control

    if options.list:
        for key, meaning in control.keys_of_all_robots():
            print(f"{key:36} {meaning}")
        return 0
    if options.key is None or options.value is None:
        raise UserError("inject needs KEY and VALUE, for example `hil inject link.command.delay 3ms`")
    print(control.inject(options.key, options.value, options.run))
    return 0


__all__ = ["EXIT_USER", "main"]

if __name__ == "__main__":
    sys.exit(main())
