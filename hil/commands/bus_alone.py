"""``hil bus up``, ``list``, ``status``, ``down``: an emulated bus by itself, in wall-clock time, for any process of
the same user."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.arguments import natural
from hil.errors import UserError

if TYPE_CHECKING:
    from bus.config import BusConfig

_RATE = re.compile(r"(\d+(?:\.\d+)?)([kM])(?:bit/s)?")
_FROM_THE_START = ("bus_off_recovery", "queue")  # what can be set, but not changed later
_CLOSE_S = 3.0  # that Zenoh may take to close
_SLOWEST, _FASTEST_CLASSICAL, _FASTEST = 5_000, 1_000_000, 8_000_000  # bit/s; ISO 11898-2, CiA 601-4


def add_parser(subcommands: Any) -> None:
    up = subcommands.add_parser("up", help="start a bus in the background")
    up.add_argument("name", metavar="NAME", type=_name, help="by which it is joined, e.g. lab")
    rates = up.add_mutually_exclusive_group()
    rates.add_argument("--fd", metavar="RATE/RATE", type=_fd, default=(1e6, 5e6),
                       help="CAN FD: arbitration and data bit rate (1M/5M)")  # fmt: skip
    rates.add_argument("--classic", metavar="RATE", type=_classic, help="classical CAN, e.g. 500k")
    up.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="a fault from the start, e.g. bus.NAME.loss=0.01 (`hil inject --list`); repeatable",
    )  # fmt: skip
    up.add_argument("--seed", type=natural, default=0, metavar="N", help="of the faults' random numbers (0)")
    up.add_argument("--log", type=Path, metavar="DIR", help="where to write (default: under XDG_STATE_HOME)")
    up.add_argument("--no-log", action="store_true", help="write nothing")
    up.add_argument("--foreground", action="store_true", help="stay, for a supervisor or a container")
    up.add_argument("--realtime", action="store_true", help="ask for SCHED_FIFO")
    up.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    up.set_defaults(command=_up)

    listing = subcommands.add_parser("list", help="list the buses that can be joined")
    listing.add_argument("--json", action="store_true")
    listing.set_defaults(command=_list)

    status = subcommands.add_parser("status", help="what a bus has done so far")
    status.add_argument("name", metavar="NAME")
    status.add_argument("--json", action="store_true")
    status.set_defaults(command=_status)

    down = subcommands.add_parser("down", help="end a bus")
    down.add_argument("name", metavar="NAME")
    down.set_defaults(command=_down)


def _name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][\w.-]{0,31}", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 1 to 32 letters, digits, _ - or .")
    return text


def _bit_rate(text: str, fastest: int) -> float:
    match = _RATE.fullmatch(text.strip())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a bit rate such as 500k or 1M")
    rate = float(match.group(1)) * {"k": 1e3, "M": 1e6}[match.group(2)]
    if not _SLOWEST <= rate <= fastest:
        raise argparse.ArgumentTypeError(f"{text!r}: expected {_SLOWEST // 1000}k to {fastest // 1_000_000}M")
    return rate


def _fd(text: str) -> tuple[float, float]:
    arbitration, separator, data = text.partition("/")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r}: expected two bit rates such as 1M/5M")
    slow, fast = _bit_rate(arbitration, _FASTEST_CLASSICAL), _bit_rate(data, _FASTEST)
    if fast < slow:
        raise argparse.ArgumentTypeError(f"{text!r}: the data phase cannot be slower than arbitration")
    return slow, fast


def _classic(text: str) -> float:
    return _bit_rate(text, _FASTEST_CLASSICAL)


def _config(options: argparse.Namespace) -> BusConfig:
    """Rates and faults of the bus. Raises UserError for a setting that is none of its own."""
    from hil.injection import of_standalone_bus
    from hil.scenario import parse_value, validate
    from hil.standalone.faults import unknown

    path = f"bus.{options.name}"
    keys = [*of_standalone_bus(options.name), *(f"{path}.{key}" for key in _FROM_THE_START)]
    slow, fast = (options.classic, options.classic) if options.classic is not None else options.fd
    values: dict[str, Any] = {"arbitration_rate": f"{slow!r} bit/s", "data_rate": f"{fast!r} bit/s"}
    for setting in options.settings:
        key, separator, value = setting.partition("=")
        if not separator:
            raise UserError(f"--set {setting}: expected KEY=VALUE, for example --set {keys[0]}=3ms")
        if key.strip() not in keys:
            raise UserError(f"--set {setting}: {unknown(options.name, key.strip(), ())}")
        parse_value(key.strip(), value.strip())  # complains with the key's name
        *tables, leaf = key.strip().split(".")[2:]
        node = values
        for table in tables:
            node = node.setdefault(table, {})
        node[leaf] = value.strip()
    return validate({"name": "bus", "bus": {options.name: values}}).bus[options.name]


def _up(options: argparse.Namespace) -> int:
    from hil.standalone import daemon

    if options.no_log and options.log is not None:
        raise UserError("--log and --no-log contradict each other")
    config = _config(options)
    try:
        directory = (options.log or daemon.state_directory() / "bus" / options.name).absolute()
    except OSError as error:
        raise UserError(f"--log {options.log}: {error.strerror}") from None

    def show(about: dict[str, Any]) -> None:
        if options.json:
            print(json.dumps(about), flush=True)
            return
        print(f"bus {about['name']} is up: {_rates(about)}, process {about['pid']}")
        print(f'attach   can.Bus(interface="hil", channel="{about["name"]}")')
        print(f"         python -m can.viewer -i hil -c {about['name']}")
        print(f"log      {about['log'] or 'none'}")
        print(f"end      hil bus down {about['name']}", flush=True)

    def main(ready: Callable[[dict[str, Any]], None]) -> None:
        _serve(options, config, None if options.no_log else directory, ready)

    if options.foreground:
        main(show)
    else:
        from hil.standalone.control import buses

        if options.name in buses():  # said before anything is written
            raise UserError(_taken(options.name))
        show(daemon.detach(main, Path(os.devnull) if options.no_log else directory / "messages.txt"))
    return 0


def _taken(name: str) -> str:
    return f"a bus {name!r} is up already (`hil bus down {name}` ends it)"


def _serve(
    options: argparse.Namespace, config: BusConfig, directory: Path | None, ready: Callable[[dict[str, Any]], None]
) -> None:
    """The process of a bus, from here to its end."""
    import zenoh

    from bus.ports import PortError
    from bus.zenoh_link import keys, session_config
    from hil.backends.lifecycle import quiet_collector
    from hil.backends.processes import free_port
    from hil.clock import request_priority
    from hil.control import between_events, serve_injections
    from hil.standalone.record import Record
    from hil.standalone.server import StandaloneBus

    name, endpoint = options.name, f"tcp/127.0.0.1:{free_port()}"
    try:
        bus = StandaloneBus(name, config, options.classic is None, endpoint, options.seed)
    except PortError:
        raise UserError(_taken(name)) from None
    record = None
    session = None
    previous: dict[int, Any] = {}
    try:
        if directory is not None:  # only now: the log of a bus that is up already must not be touched
            try:
                record = bus.record = Record(directory, name)
            except OSError as error:
                raise UserError(f"{directory}: cannot be written ({error.strerror})") from None
        scheduling = request_priority() if options.realtime else "default"  # before Zenoh's threads, which inherit it
        reason = []

        def end(number: int, _: object) -> None:
            reason.append(signal.Signals(number).name)
            bus.stop()

        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            previous[number] = signal.signal(number, end)
        signal.set_wakeup_fd(bus.wakeup_fd, warn_on_full_buffer=False)
        try:
            session = zenoh.open(session_config(endpoint, None))
        except zenoh.ZError as error:
            raise UserError(f"Zenoh could not be opened at {endpoint}: {error}") from None
        serve_injections(bus, session, name)
        session.declare_queryable(
            keys(name).status, between_events(bus, lambda _: {**bus.status(), "scheduling": scheduling})
        )
        quiet_collector()
        bus.log(f"up: {_rates(bus.status())}, process {os.getpid()}, seed {options.seed}")
        ready(bus.status())
        bus.serve()
        bus.log(f"down: {', '.join(reason)}")
        if record is not None:
            (record.directory / "status.json").write_text(json.dumps(bus.status(), indent=2), encoding="utf-8")
    finally:
        signal.set_wakeup_fd(-1)
        bus.close()  # the clients first: they are told at once
        if record is not None:
            record.close()
        if session is not None:
            # for a query that is being answered, but not for ever: the bus is down
            closing = threading.Thread(target=session.close, daemon=True)
            closing.start()
            closing.join(_CLOSE_S)
        for restored, handler in previous.items():
            signal.signal(restored, handler)


def _rates(about: dict[str, Any]) -> str:
    slow = f"{about['arbitration_rate'] / 1e6:g} Mbit/s"
    return f"CAN FD {slow} and {about['data_rate'] / 1e6:g} Mbit/s" if about["fd"] else f"classical CAN {slow}"


def _list(options: argparse.Namespace) -> int:
    from bus.ports import served
    from hil.standalone.control import buses

    alone = buses()
    others = [f"{run}/{channel}" for run, channel in served() if run not in alone]
    if options.json:
        listed = [{"channel": name, "kind": "stand-alone", **about} for name, about in alone.items()]
        print(json.dumps(listed + [{"channel": name, "kind": "run"} for name in others]))
        return 0
    for name, about in alone.items():
        print(f"{name:32} {_rates(about)}")
    for name in others:
        print(f"{name:32} bus of a run")
    if not alone and not others:
        print("none is up (`hil bus up NAME` starts one)")
    return 0


def _status(options: argparse.Namespace) -> int:
    from hil.standalone.control import status

    told = status(options.name)
    if options.json:
        print(json.dumps(told))
        return 0
    late = told["lateness"]
    print(f"{told['name']}, {_rates(told)}, process {told['pid']}, up for {told['uptime']:.1f} s")
    print(f"load      {100 * told['load']:.1f} % in the last second, {100 * told['load_mean']:.1f} % in all")
    print(
        f"frames    {told['sent']} sent, {told['lost']} lost, {told['errors']} bit errors, "
        f"{told['collisions']} collisions"
    )
    if told["misfits"]:
        print(f"          {told['misfits']} CAN FD frames refused: the bus is classical")
    print(
        f"lateness  p50 {late['p50_us']} µs, p99 {late['p99_us']} µs, max {late['max_us']} µs "
        f"behind the frame's end, scheduling {told['scheduling']}"
    )
    for client in told["clients"]:
        print(
            f"client    {client['node']}, {client['process']} ({client['pid']}): {client['sent']} sent, "
            f"{client['received']} received, {client['missed']} missed, {client['malformed']} malformed; "
            f"{client['state']}, TEC {client['tec']}, REC {client['rec']}"
            + "".join(f"; {fault} = {_written(value)}" for fault, value in client["faults"].items())
        )
    for identifier, counts in told["identifiers"].items():
        print(
            f"{identifier:>8}  {counts['sent']} sent, {counts['lost']} lost, {counts['retransmitted']} retransmitted, "
            f"waited p50 {counts['wait_p50_us']} µs, p99 {counts['wait_p99_us']} µs, max {counts['wait_max_us']} µs"
        )
    for change in told["injected"]:
        print(f"injected  {change['time_s']:.6f} s: {change['key']} = {change['value']}")
    print(f"log       {told['log'] or 'none'}{' — ' + told['log_failure'] if told['log_failure'] else ''}")
    return 0


def _written(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"


def _down(options: argparse.Namespace) -> int:
    from hil.standalone.control import down

    pid = down(options.name)
    print(f"bus {options.name} is down (process {pid} has ended)")
    return 0
