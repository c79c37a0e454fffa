"""Emulated buses: one that the test looks after, one in a process of its own in wall-clock time."""

import multiprocessing
import os
import time
from collections.abc import Iterator
from multiprocessing.synchronize import Event

import pytest

from bus.config import BusConfig
from bus.ports import PortServer
from bus.python_can import HilBus
from bus.wire import Wire
from hil.streams import streams
from tests.support.ports import RUN, attached

TOOLS = 1  # the wire's port for attached programs; port 0 acknowledges


def pump(run: str, channel: str, ready: Event, stop: Event) -> None:
    """Drive the wire by the clock until told to stop."""
    wire = Wire(channel, BusConfig(), 2, streams(1))
    server = PortServer(channel, run, port=TOOLS)
    ready.set()
    start = time.monotonic_ns()
    while not stop.wait(100e-6):
        now = time.monotonic_ns() - start
        while wire.next_ns <= now:
            for delivery in wire.advance(wire.next_ns):
                server.broadcast(delivery.time, delivery.sender, delivery.frame)
        for frame in server.poll(now):
            if not wire.offer(now, TOOLS, frame):
                server.refused(frame)
    server.close()


@pytest.fixture
def server() -> Iterator[PortServer]:
    """Of the bus CHANNEL, looked after by the test."""
    server = PortServer("left_leg", run=RUN, endpoint="tcp/127.0.0.1:1")
    yield server
    server.close()


@pytest.fixture
def bus(server: PortServer) -> Iterator[HilBus]:
    """A port on it."""
    with attached(server) as bus:
        yield bus


@pytest.fixture(scope="module")
def lab() -> Iterator[str]:
    """Channel of a bus that runs."""
    context = multiprocessing.get_context("fork")
    ready, stop = context.Event(), context.Event()
    run = f"lab-{os.getpid()}"
    process = context.Process(target=pump, args=(run, "can0", ready, stop), daemon=True)
    process.start()
    assert ready.wait(20)
    yield f"{run}/can0"
    stop.set()
    process.join(20)
    assert process.exitcode == 0
