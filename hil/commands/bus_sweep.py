"""``hil bus sweep-load``: a scenario at increasing background load, beside what the response-time analysis predicts."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import EXIT_STABLE, UserError

if TYPE_CHECKING:  # the command line starts without it
    from bus.frames import Frame
    from hil.analysis.message_set import Traffic
    from hil.scenario import Scenario

_ABOVE, _BELOW = 0x010, 0x7F0  # identifiers of the background: before and behind all of the drives' and gateway's
_TITLES = {_ABOVE: "background of higher priority", _BELOW: "background of lower priority"}
_SHARES = (0.0, 0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28, 0.32, 0.36, 0.4, 0.44)


class LoadedWire:
    """A wire on whose tool port one frame is sent periodically, at its exact times."""

    def __init__(self, wire: Any, frame: Frame, period_ns: int, first_ns: int) -> None:
        self._wire, self._frame, self._period = wire, frame, period_ns
        self._due = first_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wire, name)

    @property
    def next_ns(self) -> int:
        return min(self._wire.next_ns, self._due)

    def advance(self, now_ns: int) -> Any:
        while self._due <= now_ns:
            self._wire.offer(now_ns, self._wire.ports - 1, self._frame)
            self._due += self._period
        return self._wire.advance(now_ns)


def measure(scenario: Scenario, background: Traffic | None, seed: int) -> dict[str, Any]:
    """One run with ``background`` on every bus: its round trip [s], verdict, and the longest time that each kind of
    frame waited for the bus [s]."""
    from bus.response_time import longest_frame
    from hil.analysis.message_set import traffic
    from hil.run import Request, run
    from robots import description

    systems = []

    def prepare(assembly: Any) -> None:
        systems.append(assembly.system)
        if background is not None:
            frame = longest_frame(background.identifier, background.length)
            wires = assembly.system.wires
            # the phase drifts over that of the drives, but two buses need not start alike
            wires[:] = [
                LoadedWire(wire, frame, background.period, background.period * b // len(wires))
                for b, wire in enumerate(wires)
            ]

    record = run(Request(scenario, seed, "inline", report=False), prepare=prepare).record
    robot = description.load(scenario.robot)
    waited: dict[str, float] = {}
    for wire, bus in zip(systems[0].wires, robot.buses, strict=True):
        names = {t.identifier: t.name for t in traffic(scenario, robot, bus)}
        for (identifier, extended), wait in wire.waits().items():
            if not extended and identifier in names:
                kind = names[identifier].rpartition(" ")[2]
                waited[kind] = max(waited.get(kind, 0.0), wait.longest * 1e-9)
    metrics = record["metrics"]
    return {
        "verdict": record["verdict"],
        "round_trip": {key: metrics[f"round_trip_{key}"] for key in ("p50", "p99", "max")},
        "waited": waited,
        "bus_load": max((load for load in metrics["bus_load"].values() if load is not None), default=None),
    }


def predict(scenario: Scenario, background: Traffic | None) -> dict[str, Any]:
    """Bounds for the same, in s, None where there is none: waiting time by kind of frame, and round trip. Without
    emergencies, of which a run in order has none.

    A command uses the newest states that have arrived by the controller's tick. When the last state can miss the
    tick of its own sample, it waits for the next.
    """
    from hil.analysis.message_set import analyse, traffic
    from robots import description

    robot, controller = description.load(scenario.robot), scenario.controller
    waits: dict[str, int | None] = {}
    state: int | None = 0
    command: int | None = 0

    def larger(a: int | None, b: int | None) -> int | None:
        return None if a is None or b is None else max(a, b)

    for bus in robot.buses:
        sent = [t for t in traffic(scenario, robot, bus) if t.offset is not None]
        for r in analyse([*sent, *([background] if background else [])], scenario.bus[bus.name]):
            kind = r.message.name.rpartition(" ")[2]
            waits[kind] = larger(waits.get(kind, 0), None if r.from_queue is None else r.from_queue - r.message.frame)
            if kind == "state":
                state = larger(state, r.from_queue)
            elif kind == "command":
                command = larger(command, r.from_queue)
    round_trip = None
    if state is not None and command is not None:
        link = scenario.link
        arrives = 1e-9 * state + link.state.delay + link.state.jitter
        missed = max(-(-(arrives - controller.phase) * controller.rate // 1), 0.0)
        tick = controller.phase + missed / controller.rate
        round_trip = tick + controller.compute_time + link.command.delay + link.command.jitter + 1e-9 * command
    return {"waited": {k: None if w is None else 1e-9 * w for k, w in waits.items()}, "round_trip": round_trip}


def sweep(
    scenario: Scenario, length: int, shares: Sequence[float], seed: int, progress: Any = lambda text: None
) -> list[dict[str, Any]]:
    """Runs and predictions for background of ``length`` bytes that takes each of ``shares`` of the bus."""
    from bus.response_time import longest_frame_ns
    from bus.timing import BitRates
    from hil.analysis.message_set import Traffic

    config = next(iter(scenario.bus.values()))
    rates = BitRates(config.arbitration_rate, config.data_rate)
    found = []
    for identifier in _TITLES:
        frame = longest_frame_ns(identifier, length, rates)
        for share in shares:
            period = round(frame / share) if share else 0
            background = Traffic("background", identifier, length, period, offset=None) if share else None
            progress(f"{_TITLES[identifier]}, {100 * share:.0f} %")
            point = {"identifier": identifier, "share": share, "period": period * 1e-9}
            found.append({
                **point, "measured": measure(scenario, background, seed), "predicted": predict(scenario, background)
            })  # fmt: skip
    return found


def draw(points: Sequence[dict[str, Any]], scenario: Scenario, length: int, path: Path) -> None:
    """Waiting times and the round trip over the background's share of the bus, observed and bound."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 7.5), sharex=True, sharey="row", layout="constrained")

    def curve(column: list[dict[str, Any]], group: str, *path_: str) -> list[float]:
        values = []
        for point in column:
            value: Any = point[group]
            for key in path_:
                value = value.get(key) if isinstance(value, dict) else None
            values.append(float("nan") if value is None else 1e3 * value)
        return values

    finite = [p["predicted"]["waited"][kind] for p in points for kind in ("state", "command")]
    top = 1.15e3 * max(bound for bound in finite if bound is not None)
    for n, (identifier, title) in enumerate(_TITLES.items()):
        column = [p for p in points if p["identifier"] == identifier]
        share = [100 * p["share"] for p in column]
        waiting, trip = axes[0][n], axes[1][n]
        for kind, color in (("state", "tab:blue"), ("command", "tab:orange")):
            waiting.plot(share, curve(column, "predicted", "waited", kind), "--", color=color, label=f"{kind}: bound")
            waiting.plot(
                share, curve(column, "measured", "waited", kind), "o-", color=color, markersize=4,
                label=f"{kind}: longest seen",
            )  # fmt: skip
            for at, value in zip(share, curve(column, "measured", "waited", kind), strict=True):
                if value > top:
                    waiting.annotate(f"{value:.0f} ms", (at, top), ha="center", va="top", color=color, fontsize=8)
        waiting.set(title=f"{title} ({identifier:#05x}, {length} bytes)", ylim=(0, top))
        trip.plot(share, curve(column, "predicted", "round_trip"), "k--", label="bound")
        for key, label, style in (("max", "longest seen", "o-"), ("p99", "p99", "^-"), ("p50", "p50", "s-")):
            trip.plot(share, curve(column, "measured", "round_trip", key), style, markersize=4, label=label)
        marks = (
            ("no bound", "0.5", [p["predicted"]["round_trip"] is None for p in column]),
            ("not stable", "tab:red", [p["measured"]["verdict"] != "stable" for p in column]),
        )
        for label, color, where in marks:
            at = [x for x, marked in zip(share, where, strict=True) if marked]
            trip.plot(at, [0.04] * len(at), "s", color=color, markersize=9, transform=trip.get_xaxis_transform(),
                      label=label if any(where) else None, zorder=3 if color == "0.5" else 4,
                      fillstyle="full" if color == "0.5" else "none", markeredgewidth=3)  # fmt: skip
        trip.set(xlabel="background's share of the bus [%]", ylim=(0, None))
        trip.axhline(1e3 / scenario.controller.rate, color="0.6", linestyle=":", label="servo period")
    axes[0][0].set_ylabel("waiting for the bus [ms]")
    axes[1][0].set_ylabel("round trip: sample to its command [ms]")
    axes[0][1].legend(fontsize=8, loc="upper left", ncols=2)
    axes[1][0].legend(fontsize=8, loc="lower left", ncols=3, bbox_to_anchor=(0.0, 0.08))
    for ax in axes.ravel():
        ax.grid(alpha=0.3)
    figure.suptitle(f"{scenario.name} at increasing bus load: observed, and bound by response-time analysis")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def add_parser(commands: Any) -> None:
    parser = commands.add_parser("sweep-load", help="a scenario at increasing background load, beside its bounds")
    parser.add_argument("scenario", metavar="SCENARIO", help="a built-in scenario or the path of a .toml file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="change one value of the scenario; repeatable",
    )  # fmt: skip
    parser.add_argument("--duration", metavar="S", default="4s", help="simulated time of each run (4s)")
    parser.add_argument("--bytes", type=int, default=64, metavar="N", help="length of the background's frames (64)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of all random numbers (0)")
    parser.add_argument("--out", type=Path, default=Path("bus-load.png"), metavar="FILE.png", help="(bus-load.png)")
    parser.add_argument("--json", action="store_true", help="print all points as JSON")
    parser.set_defaults(command=_run)


def _run(options: argparse.Namespace) -> int:
    import sys

    from bus.frames import CAN_FD_LENGTHS
    from hil.scenario import load

    if options.bytes not in CAN_FD_LENGTHS:
        raise UserError(f"--bytes {options.bytes}: expected one of {', '.join(map(str, CAN_FD_LENGTHS))}")
    if options.out.suffix != ".png" or not options.out.parent.is_dir():
        raise UserError(f"--out {options.out}: expected a file that ends in .png, in a directory that is there")
    if options.seed < 0:
        raise UserError(f"--seed {options.seed}: expected 0, 1, 2 …")
    scenario = load(options.scenario, [*options.settings, f"duration={options.duration}"])
    points = sweep(scenario, options.bytes, _SHARES, options.seed, lambda text: print(text, file=sys.stderr))
    draw(points, scenario, options.bytes, options.out)
    print(json.dumps(points, allow_nan=False) if options.json else f"plot        {options.out}")
    return EXIT_STABLE
