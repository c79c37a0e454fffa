"""The command ``hil``.

Exit status: 0 stable, 1 unstable, 2 a mistake of the user's, 3 the emulation failed (or was ended by a signal).
"""

from __future__ import annotations

import os

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # 12 × 12 matrices: threads only cost, and children are forked

import argparse  # noqa: E402
import json  # noqa: E402
import re  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
import traceback  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any, NoReturn  # noqa: E402

from hil.commands import bus_command, export, joint_command  # noqa: E402
from hil.commands.arguments import natural, record_directory, with_second  # noqa: E402
from hil.errors import EXIT_EMULATION, EmulationError, HilError, UserError  # noqa: E402


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (`{self.prog} --help` lists what there is)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status."""
    try:
        options = _parser().parse_args(arguments)
        return options.command(options)
    except HilError as error:
        _complain(error)
        return error.exit_status
    except (BrokenPipeError, KeyboardInterrupt):
        return EXIT_EMULATION
    except OSError as error:  # a full disk, a socket refused: nothing that a traceback would explain better
        _complain(error)
        return EXIT_EMULATION
    except Exception:  # a mistake of ours: status 1 would read as "unstable"
        traceback.print_exc()
        return EXIT_EMULATION


def _complain(error: Exception) -> None:
    print("hil: " + " ".join(str(error).splitlines()), file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    from hil.commands import eds

    parser = _Parser(prog="hil", description="Hardware-in-the-loop style emulation of legged robots.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser("run", help="run a scenario to its verdict")
    run.add_argument("scenario", metavar="SCENARIO", help="a built-in scenario or the path of a .toml file")
    run.add_argument("--seed", type=natural, default=0, metavar="N", help="of all random numbers (0)")
    run.add_argument("--duration", metavar="S", help="simulated time, e.g. 5s")
    run.add_argument(
        "--backend", choices=("processes", "inline"), default="processes",
        help="every node a process of its own (default), or all in one",
    )  # fmt: skip
    run.add_argument(
        "--clock", choices=("virtual", "wall"), default="virtual",
        help="as fast as it goes and reproducible (default), or in real time",
    )  # fmt: skip
    run.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="change one value of the scenario, e.g. link.command.delay=3ms; repeatable",
    )  # fmt: skip
    run.add_argument("--out", type=Path, metavar="DIR", help="directory of the record (default: runs/…)")
    run.add_argument(
        "--zenoh", type=_endpoint, metavar="tcp/HOST:PORT",
        help="join this Zenoh router instead of a private session",
    )  # fmt: skip
    run.add_argument(
        "--log-format", action="append", default=[], choices=("candump", "asc", "blf", "pcap"), dest="log_formats",
        help="write this log of each bus too; repeatable (candump's is always written)",
    )  # fmt: skip
    run.add_argument(
        "--zenoh-config", type=Path, metavar="FILE",
        help="Zenoh's own configuration (.json5) for launcher and controller: TLS, access control, other transports",
    )  # fmt: skip
    run.add_argument(
        "--can", choices=("shm", "socketcan", "socketcan-plain"), default="shm",
        help="what carries the joints' frames: shared memory (default), SocketCAN with the emulated wire between the "
        "interfaces of the joints, or one plain SocketCAN interface per bus",
    )  # fmt: skip
    run.add_argument(
        "--external", type=natural, action="append", default=[], metavar="NODE",
        help="leave the joint with this node id to real hardware on its SocketCAN interface; repeatable",
    )  # fmt: skip
    run.add_argument(
        "--interface", action="append", default=[], metavar="NAME=CAN",
        help="with --can socketcan…: use the interface CAN (can0) in place of NAME (left_leg.6); repeatable",
    )  # fmt: skip
    run.add_argument("--video", action="store_true", help="also write video.mp4")
    run.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    run.set_defaults(command=_run)

    scenarios = commands.add_parser("scenarios", help="list the built-in scenarios")
    scenarios.add_argument("--json", action="store_true")
    scenarios.set_defaults(command=_scenarios)

    bench = commands.add_parser("bench", help="measure speed, memory and start-up on this machine")
    bench.add_argument(
        "what", nargs="?", choices=("bus", "joint"),
        help="only the bus, beside python-can's virtual ones; or only one drive's interrupt, beside its law alone",
    )  # fmt: skip
    bench.add_argument(
        "--duration", metavar="S", help="of each measurement: simulated time (5s), of bus and joint real (1s)"
    )
    bench.add_argument("--json", action="store_true")
    bench.set_defaults(command=_bench)

    from hil.selftest import socketcan_selftest

    socketcan_selftest.add_parser(commands)

    inject = commands.add_parser("inject", help="inject a fault into a run that is going on")
    inject.add_argument("key", nargs="?", metavar="KEY", help="e.g. link.command.delay; with --list the part to list")
    inject.add_argument("value", nargs="?", metavar="VALUE", help="with its unit, e.g. 3ms")
    inject.add_argument("--run", metavar="NAME", help="which run, when several are going on")
    inject.add_argument("--list", action="store_true", help="list all keys with range, default and meaning")
    inject.set_defaults(command=_inject)

    joint_command.add_parser(commands)
    from hil.commands import (
        bisect,
        campaign,
        compare,
        diff,
        estimators,
        gait,
        linearise,
        margin,
        protection,
        replay,
        rerun,
        steps,
        study,
        sweep,
    )
    from hil.commands import map as map_command

    replay.add_parser(commands)
    diff.add_parser(commands)
    compare.add_parser(commands)
    rerun.add_parser(commands)
    bisect.add_parser(commands)
    campaign.add_parser(commands)
    protection.add_parser(commands)
    margin.add_parser(commands)
    linearise.add_parser(commands)
    sweep.add_parser(commands)
    map_command.add_parser(commands)
    gait.add_parser(commands)
    steps.add_parser(commands)
    study.add_parser(commands)
    eds.add_parser(commands)
    export.add_parser(commands)
    estimators.add_parser(commands)
    bus_command.add_parser(commands)
    return parser


def _endpoint(text: str) -> str:
    match = re.fullmatch(r"tcp/(?:\[[0-9a-fA-F:.]+\]|[\w.-]+):(\d{1,5})", text)
    if match is None or not 0 < int(match.group(1)) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r}: expected tcp/HOST:PORT, for example tcp/127.0.0.1:7447")
    return text


def _run(options: argparse.Namespace) -> int:
    from hil.run import Request, run
    from hil.scenario import load, notes

    settings = list(options.settings)
    if options.duration is not None:
        settings.append(f"duration={with_second(options.duration)}")
    scenario = load(options.scenario, settings)
    if options.zenoh is not None and options.backend == "inline":
        raise UserError("--zenoh has no meaning with --backend inline: nothing goes through Zenoh there")
    if options.zenoh_config is not None:
        if options.zenoh is not None or options.backend == "inline":
            other = "--zenoh" if options.zenoh is not None else "--backend inline"
            raise UserError(f"--zenoh-config and {other} exclude each other")
        from bus.zenoh_link import peer_config

        try:
            peer_config(f"config:{options.zenoh_config}")
        except ValueError as error:
            raise UserError(f"--zenoh-config {error}") from None
    if options.can != "shm" and options.backend == "inline":
        raise UserError(f"--can {options.can} has no meaning with --backend inline: nothing leaves the process there")
    interfaces = _interfaces(options)
    if options.can != "shm":
        from bus.socketcan import SocketCanError, require

        try:
            require()
        except SocketCanError as error:
            raise UserError(f"--can {options.can}: {error}") from None
    stamp = time.strftime("%Y%m%d-%H%M%S")
    out = record_directory(options.out, f"{scenario.name}-seed{options.seed}-{stamp}")
    from hil.control import serve_run

    for note in notes(scenario):
        print(f"hil: note: {note}", file=sys.stderr)
    request = Request(
        scenario, options.seed, options.backend, options.clock, out, video=options.video, zenoh=options.zenoh,
        log_formats=tuple(options.log_formats),
        zenoh_config=options.zenoh_config, can=options.can, external=tuple(dict.fromkeys(options.external)),
        interfaces=interfaces,
    )  # fmt: skip
    try:
        if options.json:
            outcome = run(request, prepare=serve_run)
            print(json.dumps(outcome.record, allow_nan=False))
            return outcome.exit_status
        from hil.report.progress import Display

        with Display(scenario, sys.stderr) as display:
            outcome = run(request, display.update, prepare=serve_run)
    except ValueError as error:
        from plant.stance import StanceError  # not earlier: children start before the physics

        if not isinstance(error, StanceError):
            raise
        raise UserError(f"{options.scenario}: stance: {error}") from None
    except EmulationError as error:  # it could not start: there is no record
        if options.json:
            print(json.dumps(_stillborn(request, error)))
        raise
    _print_outcome(outcome.record)
    return outcome.exit_status


def _interfaces(options: argparse.Namespace) -> dict[str, str]:
    """``--interface`` as names by the names that they replace; checks ``--external``, too."""
    if options.interface and options.can == "shm":
        raise UserError("--interface needs --can socketcan or --can socketcan-plain")
    if options.external and (options.can != "socketcan" or options.clock != "wall"):
        raise UserError("--external needs --can socketcan and --clock wall: real hardware keeps its own time")
    pairs = [text.partition("=") for text in options.interface]
    for text, (name, _, interface) in zip(options.interface, pairs, strict=True):
        if not name or not interface:
            raise UserError(f"--interface {text}: expected NAME=CAN, for example left_leg.6=can0")
    return {name: interface for name, _, interface in pairs}


def _stillborn(request: Any, error: HilError) -> dict[str, Any]:
    """What ``--json`` prints of a run that could not start."""
    return {
        "scenario": request.scenario.name,
        "seed": request.seed,
        "backend": request.backend,
        "clock": request.clock,
        "verdict": "failed",
        "reason": str(error),
        "metrics": {},
        "log_digest": None,
        "simulated_time": 0.0,
        "realtime_factor": 0.0,
        "out": str(request.out),
    }


def _print_outcome(record: dict[str, Any]) -> None:
    metrics = record["metrics"]

    def number(key: str, scale: float, unit: str, digits: int = 1) -> str:
        value = metrics.get(key)
        return "–" if value is None else f"{value * scale:.{digits}f} {unit}"

    print(f"{record['scenario']}, seed {record['seed']}, {record['backend']}, {record['clock']} clock")
    print(f"verdict     {record['verdict']}: {record['reason']}")
    for sign in record["came_first"][:1]:
        print(f"came first  {sign['kind']}, {sign['where']}, at {sign['time']:.2f} s: {sign['sentence']}")
    print(f"simulated   {record['simulated_time']:.2f} s at {record['realtime_factor']:.2f} × real time")
    print(f"CoM error   max {number('com_error_max', 1e3, 'mm')}, rms {number('com_error_rms', 1e3, 'mm')}")
    if metrics.get("internal_force_error") is not None:
        print(
            f"int. force  error {number('internal_force_error', 100, '%')} sensed, "
            f"{number('internal_force_error_truth', 100, '%')} true"
        )
    if metrics.get("steps") is not None:
        print(
            f"steps       {metrics['steps']}, feet land within {number('foot_placement_error_rms', 100, 'cm', 2)} (rms)"
        )
    print(f"round trip  p50 {number('round_trip_p50', 1e3, 'ms', 3)}, p99 {number('round_trip_p99', 1e3, 'ms', 3)}")
    load = metrics.get("bus_load") or {}
    shares = {bus: "–" if value is None else f"{100 * value:.0f} %" for bus, value in load.items()}
    print("bus load    " + ", ".join(f"{bus} {share}" for bus, share in shares.items()))
    wall = record["wall_clock"]
    if wall is not None:
        print(f"deadlines   {100 * wall['missed_share']:.2f} % missed, scheduling {wall['scheduling']}")
        for bin_, count in wall["histogram"].items():
            if count:
                print(f"            {bin_:>24}: {count}")
        if not wall["kept_up"]:
            print("            this machine does NOT keep up at these rates: lower firmware.rate and controller.rate")
    print(f"digest      {record['log_digest']}")
    if record["reproducible_from"] == "record":
        print("            no longer from the scenario alone, something came in from outside: `hil replay` repeats it")
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
    from robots.quantities import parse_quantity

    if options.duration is None:
        options.duration = "5s" if options.what is None else "1s"
    try:
        duration = parse_quantity(with_second(options.duration), "s")
    except ValueError as error:
        raise UserError(f"--duration: {error}") from None
    if not 0.1 <= duration <= 3600:
        raise UserError(f"--duration {options.duration}: expected 0.1 s to 3600 s")
    if options.what == "bus":
        from hil.commands.bench_bus import bench_bus

        return bench_bus(duration, as_json=options.json)
    if options.what == "joint":
        from hil.commands.bench_joint import bench_joint

        return bench_joint(duration, as_json=options.json)
    from hil.commands.bench import bench

    return bench(duration, as_json=options.json)


def _inject(options: argparse.Namespace) -> int:
    from hil import control

    if options.list:
        from hil.standalone.control import injectable

        key = options.key or ""
        print("\n".join(control.listing(key, injectable(key))))
        return 0
    if options.key is None or options.value is None:
        raise UserError("inject needs KEY and VALUE, for example `hil inject link.command.delay 3ms`")
    print(control.inject(options.key, options.value, options.run))
    return 0


if __name__ == "__main__":
    sys.exit(main())
