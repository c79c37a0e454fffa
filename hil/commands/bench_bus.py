"""``hil bench bus``: frames per second through the emulated bus, beside python-can's own virtual buses in the same run.

All send the traffic of a leg in turn: a command of 64 bytes and three states of 24, with random contents. Only the
emulated bus computes when each frame ends and which goes first; it runs as fast as it can here, not at its bit rate.
Across processes a sender floods a receiver for a while; what the receiver did not get is counted as lost.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, Pipe
from typing import Any

import can

from bus import messages
from bus.config import BusConfig
from bus.frames import Frame
from bus.link import NEVER
from bus.ports import PortServer
from bus.wire import Wire
from hil.backends.lifecycle import Family
from hil.streams import streams

WIRE_TARGET = 100_000  # frames per second
REPEATS = 3
_POOL = 256  # different frames
_CHANNEL = "bench"
_MULTICAST = "239.74.163.2"  # python-can's default group; a hop limit of 0 keeps it on this machine
_NAP_S = 20e-6
_DRAIN_S = 0.5  # a receiver waits this long for what is still under way

NOTES = {
    "wire alone": "frame times from the bits, arbitration, no transport",
    "hil, one process": "the same behind python-can: socket, wire, socket",
    "virtual, one process": "a queue of objects: no timing, no arbitration",
    "hil, across processes": "timing and arbitration; reliable towards the bus, a slow reader misses frames",
    "udp_multicast, across processes": "no timing, no arbitration, no guarantee of delivery or order",
}


def _frames() -> list[tuple[int, Frame]]:
    """(port, frame) of the traffic of a leg: the gateway's command, then the drives' states."""
    draw = random.Random(1).randbytes
    kinds = itertools.cycle([(0, messages.COMMAND, messages.COMMAND_LENGTH),
                             *((n, messages.STATE + n, messages.STATE_LENGTH) for n in (1, 2, 3))])  # fmt: skip
    return [(port, Frame(identifier, draw(length))) for port, identifier, length in itertools.islice(kinds, _POOL)]


def _messages() -> list[can.Message]:
    return [
        can.Message(arbitration_id=f.id, is_extended_id=False, is_fd=True, bitrate_switch=True, data=f.data)
        for _, f in _frames()
    ]


def _wire() -> Wire:
    return Wire(_CHANNEL, BusConfig(), 4, streams(0))


def _rate(burst: Callable[[], int], seconds: float) -> dict[str, float]:
    """Frames per second of ``burst``, which returns how many it has moved, in the best of REPEATS stretches, as other
    work on the machine only ever slows it; and the processor's time per frame in all of them."""
    burst()
    best, total, cpu = 0.0, 0, time.process_time()
    for _ in range(REPEATS):
        count, began = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds / REPEATS:
            count += burst()
        best = max(best, count / elapsed)
        total += count
    return {"frames_per_s": best, "lost": 0.0, "cpu_us": 1e6 * (time.process_time() - cpu) / total}


def wire_alone(seconds: float) -> dict[str, float]:
    """Four ports that always have a frame each in arbitration."""
    wire, offers = _wire(), _frames()

    def burst() -> int:
        now, delivered = wire.next_ns, 0
        now = 0 if now == NEVER else now
        for four in range(0, _POOL, 4):
            for port, frame in offers[four : four + 4]:
                wire.offer(now, port, frame)
            while (due := wire.next_ns) != NEVER:
                now = due
                delivered += len(wire.advance(now))
        return delivered

    return _rate(burst, seconds)


def _serve(wire: Wire, server: PortServer, now: int) -> int:
    """Put what the clients have sent through the wire and hand it out; returns the time."""
    for frame in server.poll():
        wire.offer(now, 0, frame)
        while (due := wire.next_ns) != NEVER:
            now = due
            for delivery in wire.advance(now):
                server.broadcast(delivery.time, delivery.sender, delivery.frame)
    return now


@contextmanager
def _polled(server: PortServer) -> Iterator[None]:
    """Let clients in meanwhile: a new port waits for the bus to answer."""
    done = threading.Event()

    def poll() -> None:
        while not done.wait(0.001):
            server.poll()

    thread = threading.Thread(target=poll)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def hil_in_one_process(seconds: float) -> dict[str, float]:
    """Two python-can ports and the bus between them, in one thread."""
    run, wire, now, pool = f"bench-{os.getpid()}", _wire(), 0, _messages()[:16]
    server = PortServer(_CHANNEL, run=run)
    with contextlib.ExitStack() as stack:
        stack.callback(server.close)
        with _polled(server):
            sender, receiver = (
                stack.enter_context(can.Bus(interface="hil", channel=f"{run}/{_CHANNEL}")) for _ in range(2)
            )

        def burst() -> int:
            nonlocal now
            for message in pool:
                sender.send(message)
            left = len(pool)
            while left:
                now = _serve(wire, server, now)
                while left and receiver.recv(0) is not None:
                    left -= 1
            _discard(sender)
            return len(pool)

        return _rate(burst, seconds)


def _discard(bus: can.BusABC) -> None:
    """Read what waits: a sender hears its own frames, and they must not pile up."""
    for _ in range(16):
        bus.recv(0)


def virtual_in_one_process(seconds: float) -> dict[str, float]:
    """python-can's ``virtual``: two ports in one thread."""
    with (
        can.Bus(interface="virtual", channel=_CHANNEL) as sender,
        can.Bus(interface="virtual", channel=_CHANNEL) as receiver,
    ):
        pool = _messages()[:16]

        def burst() -> int:
            for message in pool:
                sender.send(message)
            return sum(receiver.recv(1.0) is not None for _ in pool)

        return _rate(burst, seconds)


# --- across processes -----------------------------------------------------------------------------------------


def _server(run: str, ready: Connection) -> None:
    server, wire, now = PortServer(_CHANNEL, run=run), _wire(), 0
    ready.send("up")
    while True:
        before, now = now, _serve(wire, server, now)
        if now == before:  # leave the core to the others
            time.sleep(_NAP_S)


def _receiver(arguments: dict[str, Any], pipe: Connection) -> None:
    """Count until nothing has come for a while; send the count and when the last came."""
    with can.Bus(**arguments) as bus:
        pipe.send("up")
        count, last = 0, 0.0
        while bus.recv(_DRAIN_S if count else 10.0) is not None:
            count += 1
            last = time.monotonic()
        pipe.send((count, last))
        pipe.recv()  # never: the family takes a child that ends for one that died


def _sender(arguments: dict[str, Any], seconds: float, pipe: Connection) -> None:
    """Send for ``seconds``; send the count and when the first went."""
    with can.Bus(**arguments) as bus:
        pool = itertools.cycle(_messages())
        count, began = 0, time.monotonic()
        while time.monotonic() - began < seconds:
            bus.send(next(pool))
            count += 1
            if not count % 16:
                _discard(bus)
        pipe.send((count, began))
        pipe.recv()


@contextmanager
def _child(family: Family, name: str, target: Callable[..., None], *arguments: Any) -> Iterator[Connection]:
    here, there = Pipe()
    family.spawn(name, target, *arguments, there)
    with here, there:
        yield here


def _answer(family: Family, pipe: Connection, whom: str) -> Any:
    return family.wait(lambda: pipe.recv() if pipe.poll() else None, whom)


def _flood(arguments: dict[str, Any], seconds: float, server: str | None) -> dict[str, float]:
    with Family() as family:
        if server is not None:
            with _child(family, "server", _server, server) as pipe:
                _answer(family, pipe, "the bus")
        with _child(family, "receiver", _receiver, arguments) as receiver:
            _answer(family, receiver, "the receiver")
            with _child(family, "sender", _sender, arguments, seconds) as sender:
                sent, began = _answer(family, sender, "the sender")
                received, ended = _answer(family, receiver, "the receiver")
        cpu_us = 1e6 * sum(_cpu_seconds(pid) for pid in family.pids.values()) / max(received, 1)
    return {"frames_per_s": received / (ended - began), "lost": 1.0 - received / sent, "cpu_us": cpu_us}


def _cpu_seconds(pid: int) -> float:
    """Processor's time that a process has used, s (resolution 10 ms)."""
    with open(f"/proc/{pid}/stat", encoding="ascii") as file:
        user, system = file.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def across_processes(arguments: dict[str, Any], seconds: float, server: str | None = None) -> dict[str, float]:
    """Frames per second that a receiver in another process gets, and the share of the sent ones that it misses: the
    best of REPEATS floods.

    Args:
        arguments: of ``can.Bus`` in both processes.
        server: name of a run to serve the bus in a third process; None: the interface needs none.
    """
    floods = [_flood(arguments, seconds / REPEATS, server) for _ in range(REPEATS)]
    return max(floods, key=lambda flood: flood["frames_per_s"])


def bench_bus(seconds: float, as_json: bool) -> int:
    """Run all measurements, each for ``seconds``, and print them. Returns the exit status."""
    results: dict[str, Any] = {}
    results["wire alone"] = wire_alone(seconds)
    results["hil, one process"] = hil_in_one_process(seconds)
    results["virtual, one process"] = virtual_in_one_process(seconds)
    run = f"bench-{os.getpid()}"
    ours = {"interface": "hil", "channel": f"{run}/{_CHANNEL}"}
    results["hil, across processes"] = across_processes(ours, seconds, server=run)
    theirs: dict[str, Any] = {"interface": "udp_multicast", "channel": _MULTICAST, "hop_limit": 0}
    try:
        with can.Bus(**theirs):
            pass
        results["udp_multicast, across processes"] = across_processes(theirs, seconds)
    except (can.CanError, OSError, ImportError) as error:  # no multicast here, or msgpack is not installed
        results["udp_multicast, across processes"] = {"unavailable": str(error)}
    if as_json:
        print(json.dumps(results))
        return 0
    print(f"traffic of a leg (64 and 24 bytes, CAN FD), {seconds:g} s each, the best of {REPEATS} parts")
    for name, result in results.items():
        if "unavailable" in result:
            print(f"  {name:32} cannot run here: {result['unavailable']}")
            continue
        lost = f", {100 * result['lost']:.1f} % lost" if result["lost"] > 0.0005 else ""
        cost = f"{result['cpu_us']:5.1f} µs of processor"
        print(f"  {name:32} {result['frames_per_s']:9,.0f} frames/s{lost:>14}, {cost}  {NOTES[name]}")
    met = results["wire alone"]["frames_per_s"] >= WIRE_TARGET
    print(f"  aim for the wire alone: ≥ {WIRE_TARGET:,} frames/s: {'met' if met else 'missed'}")
    ours_rate, theirs_rate = (
        results[f"{name}, across processes"].get("frames_per_s") for name in ("hil", "udp_multicast")
    )
    if theirs_rate is not None:
        faster = "met" if ours_rate > theirs_rate else "missed"
        print(f"  aim across processes: faster than udp_multicast: {faster}")
    return 0
