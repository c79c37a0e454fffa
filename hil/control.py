"""Reaching into a run from outside: attached tools on its buses, injections and live telemetry over Zenoh."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from bus.frames import ErrorFrame, Frame
from bus.ports import PortError, PortServer, find_runs, served
from bus.zenoh_link import keys, peer_config
from hil.errors import EmulationError, HilError, UserError
from hil.injection import Injectable, injectable, of_bus, of_standalone_bus
from hil.scenario import parse_value
from hil.schema import nearest
from robots import description

_ANSWER_TIMEOUT_S = 5.0
_RETRY_S = 0.01
_NOTICE = "with this frame the run is no longer reproducible from its scenario alone"


class PortTap:
    """Serves every bus of a run to tools of the same user (``can.Bus(interface="hil", channel="left_leg")``).

    Args:
        run: name of the run.
        buses: names of its buses, in the order of their indices.
        endpoint: where its Zenoh session listens.
        now_ns: tells the bus time.
        ports: the port of each wire that belongs to the tools.
    """

    def __init__(
        self, run: str, buses: list[str], endpoint: str | None,
        now_ns: Callable[[], int] = lambda: 0, ports: list[int] | None = None,
    ) -> None:  # fmt: skip
        self._run, self._buses, self._now_ns = run, buses, now_ns
        self._servers: list[PortServer] = []
        self.frames_in = 0
        try:
            for b, name in enumerate(buses):
                port = None if ports is None else ports[b]
                self._servers.append(PortServer(name, run, endpoint, port, notice=_NOTICE))
        except PortError:
            self.close()
            raise

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        self._servers[bus].broadcast(time_ns, sender, frame)

    def broadcast_error(self, bus: int, time_ns: int, sender: int, error: ErrorFrame) -> None:
        self._servers[bus].broadcast_error(time_ns, error, sender)

    def set_state(self, bus: int, tec: int, rec: int, state: int) -> None:
        """Of the controller that the tools on a bus share (``PortServer.set_state``)."""
        self._servers[bus].set_state(tec, rec, state)

    def poll(self) -> list[tuple[int, Frame]]:
        """Frames that tools want on the buses now."""
        now_ns = self._now_ns()
        received = [(bus, frame) for bus, server in enumerate(self._servers) for frame in server.poll(now_ns)]
        if received:
            if not self.frames_in:
                self._tell_of_the_first(received[0][0], now_ns)
            self.frames_in += len(received)
        return received

    def refused(self, bus: int, frame: Frame) -> None:
        """The wire's transmit queue was full when ``frame``, of the last ``poll``, was offered."""
        self._servers[bus].refused(frame)

    def _tell_of_the_first(self, bus: int, now_ns: int) -> None:
        print(
            f"hil: process {self._servers[bus].first_sender} sends on {self._buses[bus]} of {self._run} "
            f"from {now_ns * 1e-9:.6f} s on: this run is no longer reproducible from its scenario alone",
            file=sys.stderr,
        )

    def close(self) -> None:
        for server in self._servers:
            server.close()


def serve_run(assembly: Any) -> None:
    """Open a run to the outside: ports on its buses, and with a Zenoh session the injection query."""
    system, session = assembly.system, assembly.session
    buses = [wire.name for wire in system.wires]
    known = list(injectable(description.load(system.scenario.robot)))
    endpoint = assembly.endpoint
    try:
        ports = [wire.ports - 1 for wire in system.wires]  # the last one of each is the tools'
        assembly.tap = system.tap = PortTap(assembly.run_name, buses, endpoint, lambda: system.now_ns, ports)
    except PortError as error:
        raise UserError(f"{error}: choose another name with --out") from None
    if session is None:
        return

    assembly.queryable = serve_injections(system, session, assembly.run_name, known)


def serve_injections(system: Any, session: Any, run: str, known: list[str] | None = None) -> Any:
    """Answer the injection queries for ``run``, which takes the keys ``known``; without them it refuses others itself.
    ``system`` has ``inject(key, value)`` and ``now_ns``, and runs its ``requests`` between two events. Returns the
    queryable."""

    def change(text: str) -> dict[str, Any]:
        try:
            order = json.loads(text)
            key, value = order["key"], order["value"]
            if known is not None and key not in known:
                raise UserError(unknown_key(key, known))
            return {"value": system.inject(key, value), "time": system.now_ns * 1e-9}
        except (ValueError, KeyError, TypeError, RecursionError):
            return {"error": 'expected {"key": …, "value": …}'}

    return session.declare_queryable(keys(run).inject, between_events(system, change))


def between_events(system: Any, respond: Callable[[str], dict[str, Any]]) -> Callable[[Any], None]:
    """A handler of Zenoh queries: what ``respond(payload)`` returns, called between two events of ``system``."""

    def answer(query: Any) -> None:
        """On a thread of Zenoh's: hand over to the calendar, which responds between two events."""
        text = "" if query.payload is None else query.payload.to_bytes()[:1000].decode("utf-8", "replace")
        done = threading.Event()
        result: dict[str, Any] = {}

        def request() -> None:
            if "error" in result:  # told that it will not happen
                return
            try:
                result.update(respond(text))
            except HilError as error:
                result["error"] = str(error)
            done.set()

        system.requests.append(request)
        if not done.wait(_ANSWER_TIMEOUT_S):
            result.setdefault("error", "the run does not take requests at the moment")
        query.reply(query.key_expr, json.dumps(result).encode())

    return answer


def inject(key: str, value: str, run: str | None = None) -> str:
    """Change ``key`` of a run that is going on. Returns one sentence; raises UserError or EmulationError."""
    known = list(keys_of_all_robots())
    for run_name, bus in served():
        known += [name for name in (of_standalone_bus if run_name == bus else of_bus)(bus) if name not in known]
    if key not in known and not _of_a_client(key):
        raise UserError(unknown_key(key, known))
    parse_value(key, value)
    runs = find_runs()
    if run is not None:
        runs = {name: hello for name, hello in runs.items() if name == run}
    if not runs:
        raise UserError(f"no run {run!r} is going on" if run else "no run is going on")
    if len(runs) > 1 and key.startswith("bus."):  # only some have this bus
        serving = {name for name, channel in served() if channel == key.split(".")[1]}
        runs = {name: hello for name, hello in runs.items() if name in serving} or runs
    if len(runs) > 1:
        raise UserError(f"several runs are going on, name one with --run: {', '.join(sorted(runs))}")
    name, hello = next(iter(runs.items()))
    if not hello.get("endpoint"):
        raise UserError(f"{name} runs inline, without Zenoh: put the change into its scenario as [[inject]]")
    payload = json.dumps({"key": key, "value": value}).encode()
    result = ask(name, hello["endpoint"], keys(name).inject, payload)
    return f"{key} = {value} from {result['time']:.6f} s of {name} on"


def _of_a_client(key: str) -> bool:
    """Whether ``key`` may be a fault of a client of a stand-alone bus: which there are, only the bus knows."""
    return any(run == bus and key.startswith(f"bus.{bus}.node.") for run, bus in served())


def ask(name: str, endpoint: str, key: str, payload: bytes = b"") -> dict[str, Any]:
    """The answer of the run ``name`` to a query. Raises EmulationError when there is none, and UserError when it
    refuses."""
    import zenoh

    try:
        session = zenoh.open(peer_config(endpoint))
    except zenoh.ZError as error:
        raise EmulationError(f"{name} cannot be reached at {endpoint}: {error}") from None
    deadline = time.monotonic() + _ANSWER_TIMEOUT_S
    try:
        while True:
            reply = next(iter(session.get(key, payload=payload, timeout=_ANSWER_TIMEOUT_S + 1)), None)
            if reply is not None and reply.ok is not None:
                result = json.loads(reply.ok.payload.to_bytes())
                if "error" in result:
                    raise UserError(result["error"])
                return result
            if reply is not None or time.monotonic() > deadline:
                break
            time.sleep(_RETRY_S)  # a busy run may be connected before it has told what it answers
    finally:
        session.close()
    raise EmulationError(f"{name} did not answer")


def unknown_key(key: object, known: list[str]) -> str:
    return f"unknown key {key!r}{nearest(str(key), known)} (`hil inject --list` lists all)"


def keys_of_all_robots() -> dict[str, Injectable]:
    """All that can be injected, by key, whatever the robot."""
    return {k: v for name in description.available() for k, v in injectable(description.load(name)).items()}


def listing(prefix: str = "", alone: Mapping[str, Injectable] | None = None) -> list[str]:
    """Lines that explain the injectable keys, all of runs or those under ``prefix``, which may also be one of the keys
    ``alone``, of a stand-alone bus. Raises UserError when there is none."""
    known = keys_of_all_robots() | dict(alone or {})
    entries = [v for k, v in known.items() if f"{k}.".startswith(f"{prefix}." if prefix else "")]
    if not entries:
        raise UserError(unknown_key(prefix, list(known)))
    rows = [("KEY", "RANGE", "DEFAULT", "MEANING")]
    rows += [(e.key, e.range, _shown(e.written(e.default)), e.meaning) for e in entries]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    return ["  ".join([*(f"{row[c]:{widths[c]}}" for c in range(3)), row[3]]) for row in rows]


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
