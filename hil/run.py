"""One run from a scenario to a directory with its record: builds the nodes, drives the calendar, judges."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hil.backends.lifecycle import Family
from hil.clock import VirtualClock, WallClock
from hil.commands.eds import write_data_sheets
from hil.compiled import compile_function, compiler
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, EmulationError, HilError, Interrupted
from hil.report.html import Link
from hil.scenario import Scenario
from hil.streams import streams
from robots import description

_SLICE_NS = 10_000_000  # signals and progress are looked at this often, in simulated time


@dataclass(frozen=True)
class Request:
    """What to run and how."""

    scenario: Scenario
    seed: int = 0
    backend: str = "processes"  # or "inline"
    clock: str = "virtual"  # or "wall"
    out: Path | None = None  # None: nothing is written
    video: bool = False
    zenoh: str | None = None  # endpoint of a router to join
    zenoh_config: Path | None = None  # Zenoh's configuration of both sessions, instead
    can: str = "shm"  # what carries the joints' frames; or "socketcan", "socketcan-plain"
    external: tuple[int, ...] = ()  # node ids of joints that are real hardware on their SocketCAN interface
    interfaces: Mapping[str, str] = field(default_factory=dict)  # SocketCAN interfaces to use in place of others
    report: bool = True
    part_of: Link | None = None  # the page that the report belongs to
    journal: Any = None  # a hil.record.journal.Journal to write to instead of the one of the directory
    signals: bool = True  # whether SIGINT, SIGTERM and SIGHUP end the run in order; else they are the caller's
    log_formats: tuple[str, ...] = ()  # of each bus, beside candump's: of bus.logs.FORMATS


@dataclass(repr=False)
class Outcome:
    """What came out; ``record`` is what run.json holds."""

    record: dict[str, Any]
    exit_status: int
    tables: dict[str, Any] = field(default_factory=dict)
    last_seconds: Any = None  # at the rate of the physics, of a run that has failed (hil.record.signals.Signals)

    @property
    def stable(self) -> bool:
        return self.exit_status == EXIT_STABLE

    @property
    def reason(self) -> str:
        """Why the verdict is what it is, one sentence."""
        return self.record["reason"]

    @property
    def metrics(self) -> dict[str, Any]:
        """Numbers that describe the run, SI units; None where one has no meaning in it."""
        return self.record["metrics"]

    @property
    def digest(self) -> str:
        """SHA-256 of all that was recorded."""
        return self.record["log_digest"]

    def __repr__(self) -> str:
        return f"<{self.record['scenario']}, seed {self.record['seed']}, {self.record['verdict']}: {self.reason}>"


@dataclass
class Assembly:
    """A system ready to run, with what its life depends on."""

    system: Any
    recorder: Any
    family: Family
    run_name: str
    session: Any = None
    endpoint: str | None = None
    pids: dict[str, int] = field(default_factory=dict)
    world: Any = None
    tap: Any = None
    queryable: Any = None
    kernel: Any = None  # SocketCAN, when the joints' frames cross it


Progress = Callable[[Any, float], None]  # system, wall seconds since the first tick


@contextlib.contextmanager
def assemble(
    request: Request,
    wrap: Callable[[str, Any], Any] = lambda _, node: node,
    alter: Callable[[description.Robot], description.Robot] = lambda robot: robot,
) -> Iterator[Assembly]:
    """Build all nodes on the backend and connect them; on leaving, every process and socket of the run is gone.

    ``wrap(name, node)`` may put a proxy around a node or host (the benchmark measures through it). ``alter(robot)`` may
    put another description in place of every one that is loaded (inline only: the other backend's controller loads its
    own).
    """
    scenario = request.scenario
    robot = alter(description.load(scenario.robot))
    random = streams(request.seed)
    with contextlib.ExitStack() as stack:
        kernel = None
        if request.can != "shm":
            from hil.backends.socketcan import SocketCan

            kernel = stack.enter_context(SocketCan(robot, scenario, request.can, request.external, request.interfaces))
        family = stack.enter_context(Family(request.signals))
        if request.clock == "wall":
            wall = WallClock(round(1e9 / scenario.firmware.rate))
            wall.request_priority()  # before the children are forked: they inherit it
            clock: VirtualClock | WallClock = wall
        else:
            clock = VirtualClock()

        from joint_firmware.firmware import JointFirmware

        nodes: list[Any] = [
            JointFirmware(robot, j, scenario.firmware, compile=compile_function) for j in range(len(robot.joints))
        ]
        if request.external:
            from hil.backends.external import ExternalJoint

            for j, joint in enumerate(robot.joints):
                if joint.node_id in request.external:
                    nodes[j] = ExternalJoint(joint)
        run_name = request.out.name if request.out is not None else f"run-{os.getpid()}"
        joints: Any
        controller: Any
        session = None
        if request.backend == "processes":
            from hil.backends.processes import ProcessController, ProcessJoints, SharedPins

            shared = SharedPins(len(nodes))
            channel = {name: bus.name for bus in robot.buses for name in bus.joints}
            controller = ProcessController(family, run_name, scenario, _where(request))
            if kernel is not None:
                joints = kernel.joints(family, nodes, shared)
            else:
                joints = ProcessJoints(
                    family, nodes, robot.joint_names, [channel[n] for n in robot.joint_names], shared
                )
        from plant.world import World

        world = World(
            alter(description.load(scenario.robot, scenario.world.variant)),
            scenario.world.model_copy(update={"variant": None}), scenario.terrain, scenario.stance, scenario.sensors,
            scenario.push, random, compile=compile_function, imu_rate=scenario.firmware.report_rate,
            motion_capture=scenario.motion_capture,
        )  # fmt: skip
        from central_controller.controller import telemetry_fields

        if request.backend == "processes":
            world.attach_pins(shared.inputs, shared.outputs)
            session = controller.open(len(telemetry_fields(robot, scenario.controller)))
        else:
            from central_controller.controller import Controller
            from hil.backends.inline import InlineController, InlineJoints

            joints = InlineJoints(nodes, world.pins_in, world.pins_out)
            model = alter(description.load(scenario.robot, scenario.controller.variant))
            controller = InlineController(Controller(model, scenario.controller, compile=compile_function))

        from hil.analysis.verdict import Monitor
        from hil.record.journal import Journal
        from hil.record.recorder import Recorder
        from hil.record.ring import StepRing
        from hil.system import System

        buses = [bus.name for bus in robot.buses]
        channels = {
            "world": list(world.truth_fields),
            "controller": telemetry_fields(robot, scenario.controller),
            "drives": [f"{what}.{j}" for what in ("statusword", "error", "round_trip") for j in robot.joint_names],
            "bus": [f"{what}.{b}" for what in ("load", "sent", "lost", "errors") for b in buses],
        }
        if world.motion_capture is not None:
            channels["motion_capture"] = list(world.motion_capture.row_fields)
        recorder = Recorder(request.out, channels, buses, log_formats=request.log_formats)
        journal = request.journal if request.journal is not None else Journal(request.out)
        assembly = None
        try:
            system = System(
                scenario,
                robot,
                wrap("physics", world),
                wrap("firmware", joints),
                wrap("controller", controller),
                wrap("recorder", recorder),
                random,
                clock,
                Monitor(scenario.limits, channels),
                journal,
            )
            if kernel is not None:
                kernel.connect(system)
            system.ring = StepRing(world.every_step(), scenario.world.rate)
            system.wires = [wrap("bus", wire) for wire in system.wires]
            pids = {"launcher": os.getpid(), **family.pids}
            endpoint = controller.endpoint if session is not None else None
            assembly = Assembly(system, recorder, family, run_name, session, endpoint, pids, world, kernel=kernel)
            yield assembly
        finally:
            if assembly is not None and assembly.tap is not None:
                assembly.tap.close()
            recorder.close()
            journal.close()
            if session is not None:
                controller.close()


def _where(request: Request) -> str | None:
    """Where launcher and controller meet, as of ``bus.zenoh_link.peer_config``; None: by themselves."""
    if request.zenoh_config is not None:
        return f"config:{request.zenoh_config.resolve()}"
    return f"router:{request.zenoh}" if request.zenoh is not None else None


def run(
    request: Request, progress: Progress | None = None, prepare: Callable[[Assembly], None] | None = None
) -> Outcome:
    """Run to the end, to a fall, or to a signal; write the record. Raises HilError when it could not start."""
    scenario = request.scenario
    end_ns = round(scenario.duration * 1e9)
    failure: HilError | None = None
    if request.out is not None:
        request.out.mkdir(parents=True, exist_ok=True)
        write_data_sheets(request.out, scenario)  # for masters that join while it runs
    with assemble(request) as assembly:
        system = assembly.system
        if prepare is not None:
            prepare(assembly)
        system.journal.write({"run": origin(request)})
        if assembly.kernel is not None:
            assembly.tap = system.tap = assembly.kernel.tools(system.tap)
        start_up = process_age()
        system.clock.start()
        first = time.monotonic()
        try:
            while system.now_ns < end_ns and system.stop_reason is None:
                system.run_until(min(system.now_ns + _SLICE_NS, end_ns))
                assembly.family.check()
                if progress is not None:
                    progress(system, time.monotonic() - first)
        except (Interrupted, EmulationError) as error:
            failure = error
        elapsed = time.monotonic() - first
        memory = {name: _resident(pid) for name, pid in assembly.pids.items()}
        link = None
        if failure is None and request.backend == "processes":
            with contextlib.suppress(HilError):  # ended just now
                link = assembly.system.controller.link_report()
        assembly.family.end()
        recorder = assembly.recorder
        if failure is None:
            system.journal.write({"end_ns": system.now_ns, "digest": recorder.digest()})
    return conclude(request, system, recorder, failure, elapsed, start_up, memory, link)


def conclude(
    request: Request, system: Any, recorder: Any, failure: HilError | None, elapsed: float, start_up: float = 0.0,
    memory: Mapping[str, int] = MappingProxyType({}), link: dict[str, Any] | None = None,
) -> Outcome:  # fmt: skip
    """Judge the run as far as it has come, and write its record if it has a directory.

    Args:
        elapsed: wall-clock time since its first tick, s.
        memory: bytes by process.
    """
    from hil.analysis.bus_statistics import bus_statistics
    from hil.analysis.verdict import judge

    scenario = request.scenario
    tables = recorder.tables()
    simulated = system.now_ns * 1e-9
    verdict = judge(tables, scenario, stopped=system.stop_reason)
    if failure is not None:
        name, reason, status = "failed", str(failure), failure.exit_status
    elif verdict.stable:
        name, reason, status = "stable", verdict.reason, EXIT_STABLE
    else:
        name, reason, status = "unstable", verdict.reason, EXIT_UNSTABLE
    came_first = []
    if name == "unstable":
        from hil.analysis.causes import signs

        came_first = [asdict(sign) for sign in signs(tables, scenario)]
    record: dict[str, Any] = {
        "scenario": scenario.name,
        "seed": request.seed,
        "backend": request.backend,
        "clock": request.clock,
        "can": request.can,
        "external": list(request.external),
        "verdict": name,
        "reason": reason,
        "came_first": came_first,
        "metrics": verdict.metrics,
        "bus": bus_statistics(system.wires, scenario),
        "log_digest": recorder.digest(),
        "simulated_time": simulated,
        "realtime_factor": simulated / elapsed if elapsed > 0 else 0.0,
        "start_up_time": start_up,
        "memory_bytes": {**memory, "sum": sum(memory.values())},
        "wall_clock": system.clock.report(),
        "deliveries": system.deliveries(),
        "link": link,
        "injected": system.injected,
        "tool_frames": system.tool_frames,
        "reproducible_from": system.reproducible_from,
        "out": None if request.out is None else str(request.out),
        "versions": versions(),
        "configuration": scenario.model_dump(mode="json"),
    }
    failed = system.stop_reason is not None and system.ring is not None
    outcome = Outcome(record, status, tables, system.ring.table(system.world.steps) if failed else None)
    if request.out is not None:
        if request.video and len(tables["world"]):
            from hil.report.video import write_video

            write_video(request.out, scenario, tables)
        write_record(request.out, scenario, outcome, request.report, request.part_of)
    return outcome


def origin(request: Request) -> dict[str, Any]:
    """What a run starts from: with what came into it from outside, all that determines it."""
    return {
        "seed": request.seed,
        "backend": request.backend,
        "clock": request.clock,
        "versions": versions(),
        "configuration": request.scenario.model_dump(mode="json"),
    }


def write_record(
    directory: Path, scenario: Scenario, outcome: Outcome, report: bool = True, part_of: Link | None = None
) -> None:
    """Write what stands in a run's directory beside its signals, logs and journal: DBC files, verdict, report.

    ``part_of``: the page that the run belongs to.
    """
    from bus.dbc import dbc

    robot = description.load(scenario.robot)
    for bus in robot.buses:
        (directory / f"{bus.name}.dbc").write_text(dbc(robot, bus), encoding="utf-8")
    if outcome.last_seconds is not None:
        from hil.record.mcap_writer import McapWriter
        from hil.record.ring import CHANNEL, LAST_SECONDS_FILE

        table = outcome.last_seconds
        writer = McapWriter(directory / LAST_SECONDS_FILE, {CHANNEL: table.names})
        writer.write(CHANNEL, table.times, table.data)
        writer.close()
    above = {} if part_of is None else {"part_of": part_of._asdict()}  # for whoever writes the report anew
    partial = directory / "run.json.part"
    partial.write_text(json.dumps(outcome.record | above, indent=2), encoding="utf-8")
    partial.replace(directory / "run.json")  # never half a record
    if report and len(outcome.tables["world"]) > 10:
        from hil.report.page import write_report

        write_report(directory, outcome.record, outcome.tables, part_of)


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    names = ("hume-hil", "casadi", "eclipse-zenoh", "mujoco", "numpy", "pin", "python-can", "scipy")
    found = {}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "compiler": compiler() or "none: CasADi's virtual machine",
        **found,
    }


def process_age() -> float:
    """Seconds since this process was created (resolution of /proc: 10 ms)."""
    with open("/proc/self/stat", encoding="ascii") as file:
        started = int(file.read().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started


def _resident(pid: int) -> int:
    """Resident memory of a process in bytes, 0 when it is gone."""
    try:
        with open(f"/proc/{pid}/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0
