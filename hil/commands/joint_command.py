"""``hil joint``: one emulated joint, with a little plant of its own, on any python-can bus."""

from __future__ import annotations

import argparse
import json
import signal
from typing import TYPE_CHECKING, Any

from hil.commands import joint_calibrate, joint_chirp, joint_margins, joint_onboard, joint_step
from hil.commands.arguments import natural
from hil.commands.joint_arguments import LOADS, load_of, node_id, scenario_of, seconds, which
from hil.errors import EmulationError, UserError

if TYPE_CHECKING:
    from hil.scenario import Scenario
    from plant.bench import Bench


def add_parser(commands: Any) -> None:
    joint = commands.add_parser(
        "joint", help="one emulated joint on a CAN bus, and the laboratory of its torque loop",
        description="The firmware of one joint, its actuator and a load, in real time on a CAN FD bus; or, with a "
        "subcommand, the analysis of its torque loop.",
    )  # fmt: skip
    joint.add_argument("--robot", default="hume", metavar="NAME", help="whose joint, or a TOML file of one (hume)")
    joint.add_argument("--node", type=node_id, metavar="ID", help="CANopen node id of the joint")
    joint.add_argument("--joint", metavar="NAME", help="instead of --node, e.g. left_knee")
    joint.add_argument("--can", metavar="INTERFACE:CHANNEL", help="hil:lab, socketcan:can0 …")
    joint.add_argument(
        "--load", default="inertia", metavar="LOAD", help=f"on the output: {LOADS}; at=0.3rad starts it there"
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
    subcommands = joint.add_subparsers(metavar="COMMAND")
    for module in (joint_margins, joint_chirp, joint_step, joint_onboard, joint_calibrate):
        module.add_parser(subcommands)


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


def _joint(options: argparse.Namespace) -> int:
    if options.can is None:
        raise UserError("name the bus, e.g. --can hil:lab, or a COMMAND (`hil joint --help` lists what there is)")
    scenario = scenario_of(options, {"joint.": "joint.NAME.…"})
    duration, load = seconds(options.duration), load_of(options.load)
    from hil.backends.lifecycle import quiet_collector
    from hil.compiled import compile_function
    from hil.standalone.joint import StandaloneJoint, open_bus
    from hil.streams import streams
    from joint_firmware.firmware import JointFirmware
    from plant.actuators.model import NoModelError
    from plant.bench import Bench
    from robots import description

    robot = description.load(scenario.robot)
    index = which(options, robot)
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
