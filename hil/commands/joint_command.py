"""``hil joint``: one emulated joint, with a little plant of its own, on any python-can bus."""

from __future__ import annotations

import argparse
import json
import math
import signal
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import natural
from hil.errors import EmulationError, UserError

if TYPE_CHECKING:
    from hil.scenario import Scenario
    from plant.bench import Bench, Load
    from robots.description import Robot

_PHYSICS = 3000.0  # Hz, at least
_LOADS = "inertia=0.5kgm2[,damping=0.5Nms/rad] | pendulum[,mass=3kg,length=0.4m,damping=0.5Nms/rad] | locked"


def add_parser(commands: Any) -> None:
    joint = commands.add_parser(
        "joint", help="one emulated joint on a CAN bus",
        description="The firmware of one joint, its actuator and a load, in real time on a CAN FD bus.",
    )  # fmt: skip
    joint.add_argument("--robot", default="hume", metavar="NAME", help="whose joint, or a TOML file of one (hume)")
    joint.add_argument("--node", type=_node, metavar="ID", help="CANopen node id of the joint")
    joint.add_argument("--joint", metavar="NAME", help="instead of --node, e.g. left_knee")
    joint.add_argument("--can", required=True, metavar="INTERFACE:CHANNEL", help="hil:lab, socketcan:can0 …")
    joint.add_argument(
        "--load", default="inertia", metavar="LOAD", help=f"on the output: {_LOADS}; at=0.3rad starts it there"
    )
    joint.add_argument("--rate", metavar="HZ", help="ISR rate, e.g. 1kHz; it reports at half of it (3kHz)")
    joint.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="as in a scenario, e.g. firmware.watchdog=50ms; repeatable",
    )  # fmt: skip
    joint.add_argument("--seed", type=natural, default=0, metavar="N", help="of the sensors' errors (0)")
    joint.add_argument("--duration", metavar="S", help="end after this time, e.g. 5s")
    joint.add_argument("--realtime", action="store_true", help="ask for SCHED_FIFO")
    joint.add_argument("--json", action="store_true", help="print one JSON object at the end and nothing else")
    joint.set_defaults(command=_joint)


def _node(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 3 and 1 <= int(text) <= 127):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 1 to 127")
    return int(text)


def _which(options: argparse.Namespace, robot: Robot) -> int:
    """Index of the joint that is meant."""
    from hil.schema import nearest

    nodes = {joint.node_id: n for n, joint in enumerate(robot.joints)}
    if (options.node is None) == (options.joint is None):
        raise UserError("name the joint, either by --node or by --joint, for example --node 3")
    if options.joint is not None:
        if options.joint not in robot.joint_names:
            raise UserError(
                f"--joint {options.joint}: {robot.name} has none{nearest(options.joint, robot.joint_names)}"
            )
        return robot.joint_names.index(options.joint)
    if options.node not in nodes:
        there = ", ".join(f"{node} ({robot.joints[n].name})" for node, n in nodes.items())
        raise UserError(f"--node {options.node}: {robot.name} has none; there is {there}")
    return nodes[options.node]


def _load(text: str) -> Load:
    """The load that ``KIND[=VALUE][,KEY=VALUE…]`` describes."""
    from pydantic import ValidationError

    from hil import schema
    from plant.bench import LOADS

    parts = text.split(",")
    kind = parts[0].partition("=")[0].strip()
    if kind not in LOADS:
        raise UserError(f"--load {text}: no load {kind!r}{schema.nearest(kind, list(LOADS))}")
    values = {}
    for part in parts if "=" in parts[0] else parts[1:]:
        key, separator, value = part.partition("=")
        if not separator:
            raise UserError(f"--load {text}: {part!r} is not KEY=VALUE")
        values[key.strip()] = value.strip()
    try:
        return LOADS[kind].model_validate(values)
    except ValidationError as error:
        raise UserError(f"--load {text}: {schema.sentence(error.errors()[0], LOADS[kind])}") from None


def _scenario(options: argparse.Namespace) -> Scenario:
    """What of a scenario a joint alone has: firmware, sensors, the actuator's friction and the physics' rate."""
    from hil.scenario import load
    from robots.quantities import parse_quantity

    allowed = ("firmware.", "sensors.", "joint.", "world.friction_scale=", "world.rate=")
    for setting in options.settings:
        if not setting.strip().startswith(allowed):
            raise UserError(
                f"--set {setting}: a joint alone has firmware.…, sensors.…, joint.NAME.…, world.friction_scale and "
                "world.rate"
            )
    named = {setting.partition("=")[0].strip() for setting in options.settings}
    settings = [f"robot={options.robot}", *options.settings]
    if options.rate is not None:
        try:
            rate = parse_quantity(options.rate, "Hz")
        except ValueError as error:
            raise UserError(f"--rate {options.rate}: {error}") from None
        if not 1 <= rate <= 1e6:
            raise UserError(f"--rate {options.rate}: expected 1 Hz to 1 MHz")
        settings.append(f"firmware.rate={rate:.12g} Hz")
        if "firmware.report_rate" not in named:
            settings.append(f"firmware.report_rate={rate / 2:.12g} Hz")
        if "world.rate" not in named:
            settings.append(f"world.rate={rate * math.ceil(_PHYSICS / rate):.12g} Hz")
    try:
        return load("stand", settings)
    except UserError as error:
        raise UserError(str(error).removeprefix("stand: ")) from None  # which scenario does not matter


def _set_faults(bench: Bench, joint: str, scenario: Scenario) -> None:
    """What is wrong with the joint from the start. Raises UserError for a fault that a joint alone cannot have."""
    for name, faults in scenario.joint.items():
        if name != joint:
            raise UserError(f"--set joint.{name}: the joint here is {joint}")
        for key in faults.model_fields_set:
            try:
                bench.faults.set(0, key, getattr(faults, key))
            except KeyError:
                raise UserError(
                    f"--set joint.{name}.{key}: a joint alone has no controller; send such commands yourself"
                ) from None


def _seconds(text: str | None) -> float | None:
    from robots.quantities import parse_quantity

    if text is None:
        return None
    try:
        duration = parse_quantity(text, "s")
    except ValueError as error:
        raise UserError(f"--duration: {error}") from None
    if not 0 < duration <= 1e6:
        raise UserError(f"--duration {text}: expected more than 0 s")
    return duration


def _joint(options: argparse.Namespace) -> int:
    scenario = _scenario(options)
    duration, load = _seconds(options.duration), _load(options.load)
    from hil.backends.lifecycle import quiet_collector
    from hil.compiled import compile_function
    from hil.standalone.joint import StandaloneJoint, open_bus
    from hil.streams import streams
    from joint_firmware.firmware import JointFirmware
    from plant.actuators.model import NoModelError
    from plant.bench import Bench
    from robots import description

    robot = description.load(scenario.robot)
    index = _which(options, robot)
    joint = robot.joints[index]
    if not joint.limits[0] <= load.at <= joint.limits[1]:
        low, high = joint.limits
        raise UserError(
            f"--load {options.load}: {joint.name} goes from {low:g} rad to {high:g} rad, not to at = {load.at:g}"
        )
    rate, physics = int(scenario.firmware.rate), scenario.world.rate
    firmware = JointFirmware(robot, index, scenario.firmware, compile_function)
    try:
        bench = Bench(
            robot, index, load, physics, scenario.sensors, streams(options.seed), scenario.world.friction_scale,
            compile_function,
        )  # fmt: skip
    except ValueError as error:
        raise UserError(f"--load {options.load}: {error}") from None
    except NoModelError as error:
        raise UserError(f"--robot {options.robot}: joint {joint.name}: {error}") from None
    _set_faults(bench, joint.name, scenario)
    bus = open_bus(options.can)
    previous: dict[int, Any] = {}
    try:
        node = StandaloneJoint(firmware, bench, bus, rate, int(physics) // rate)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            previous[number] = signal.signal(number, lambda *_: node.stop())
        if options.realtime:
            node.clock.request_priority()
        if not options.json:
            print(
                f"{joint.name} (node {joint.node_id}) on {options.can}: {rate} Hz, load {load!r}; Ctrl-C ends it",
                flush=True,
            )
        quiet_collector()
        try:
            node.run(duration)
        except EmulationError as error:
            raise EmulationError(f"--can {options.can}: {error}") from None
    finally:
        bus.shutdown()
        for restored, handler in previous.items():
            signal.signal(restored, handler)
    report = node.report()
    print(json.dumps(report)) if options.json else _print(report)
    return 0


def _print(report: dict[str, Any]) -> None:
    wall = report["wall_clock"]
    print(f"ended in {report['state']} after {report['ticks']} interrupts")
    print(
        f"frames     {report['sent']} sent, {report['dropped']} not taken by the bus, {report['received']} received, "
        f"{report['ignored'] + report['malformed']} malformed"
    )
    print(
        f"deadlines  {100 * wall['missed_share']:.2f} % missed, late by p50 {wall['lateness_p50_us']} µs, "
        f"p99 {wall['lateness_p99_us']} µs, max {wall['lateness_max_us']} µs, scheduling {wall['scheduling']}"
    )
    if not wall["kept_up"]:
        print("           this machine does NOT keep up at this rate: lower --rate")
