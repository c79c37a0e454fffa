"""What becomes of a frame that a program sends."""

import asyncio
import select
import socket
from concurrent.futures import ThreadPoolExecutor

import can
import pytest

from bus.frames import Frame
from bus.link import NEVER
from bus.port_client import IN_FLIGHT, WINDOW, Client
from bus.ports import PortServer
from bus.python_can import HilBus
from bus.records import (
    OWN,
    kind_and_tag,
    pack_frame,
    pack_task,
)
from bus.wire import QUEUE
from tests.support.ports import RUN, attached, message


def test_a_sender_learns_when_its_frame_was_on_the_bus(server: PortServer, bus: HilBus) -> None:
    sent = [bus.transmit(message(data=[n])) for n in range(3)]
    bus.send(message(0x11))
    frames = server.poll(0)
    for time_ns, n in ((5_000, 1), (7_000, 0), (9_000, 3)):  # number 2 still waits
        server.broadcast(time_ns, 4, frames[n])
    assert [sent[n].result(1.0) for n in (1, 0)] == [5e-6, 7e-6]
    assert not sent[2].done()
    with pytest.raises(can.CanTimeoutError, match=r"not on the bus within 0\.01 s"):
        sent[2].result(0.01)
    assert not sent[2].cancel()


def test_send_with_a_timeout_waits_for_the_bus(server: PortServer, bus: HilBus) -> None:
    with pytest.raises(can.CanTimeoutError):
        bus.send(message(), timeout=0.01)  # nobody looks after the bus
    with ThreadPoolExecutor(1) as pool:
        sending = pool.submit(bus.send, message(0x12), 10.0)
        frames: list[Frame] = []
        while len(frames) < 2:
            assert not sending.done()
            frames += server.poll(0)
        server.broadcast(1_000, 4, frames[1])
        assert sending.result(10.0) is None


def test_messages_that_come_while_a_sender_waits_are_kept(server: PortServer, bus: HilBus) -> None:
    server.broadcast(1, 1, Frame(0x181, b"\x01"))
    sent = bus.transmit(message())
    (frame,) = server.poll(0)
    server.broadcast(2, 4, frame)
    assert sent.result(1.0) == 2e-9
    assert select.select([bus], [], [], 0)[0] == [bus]  # although the socket itself is empty
    received = bus.recv(0)
    assert received is not None and received.arbitration_id == 0x181
    assert select.select([bus], [], [], 0)[0] == []


def test_a_frame_that_does_not_appear_is_given_up_after_a_second_of_bus_time(server: PortServer, bus: HilBus) -> None:
    sent = bus.transmit(message())
    assert len(server.poll(7)) == 1
    server.poll(10**9 + 6)
    with pytest.raises(can.CanTimeoutError):
        sent.result(0.0)
    server.poll(10**9 + 7)
    with pytest.raises(can.CanOperationError, match="not on the bus within a second of bus time"):
        sent.result(1.0)


def test_flushing_discards_what_the_controller_has_not_got(server: PortServer, bus: HilBus) -> None:
    sent = [bus.transmit(message(data=[n])) for n in range(IN_FLIGHT + 5)]
    frames = server.poll(0)
    assert [frame.data[0] for frame in frames] == list(range(IN_FLIGHT))
    bus.flush_tx_buffer()
    assert server.poll(0) == []
    for frame in frames:
        server.broadcast(1_000, 4, frame)
    assert server.poll(0) == []
    for transmission in sent[:IN_FLIGHT]:
        assert transmission.result(1.0) == 1e-6
    for transmission in sent[IN_FLIGHT:]:
        with pytest.raises(can.CanOperationError, match="discarded"):
            transmission.result(1.0)


def test_a_frame_that_the_wire_refuses_is_offered_again(server: PortServer, bus: HilBus) -> None:
    for n in range(3):
        bus.send(message(data=[n]))
    frames = server.poll(0)
    for frame in reversed(frames[1:]):
        server.refused(frame)
    assert server.poll(0) == frames[1:]


def test_a_client_may_have_a_window_of_frames_and_then_waits(server: PortServer, bus: HilBus) -> None:
    for n in range(WINDOW):
        bus.send(message(data=[n]), timeout=0)
    with pytest.raises(can.CanTimeoutError, match="transmit buffer is full"):
        bus.send(message(), timeout=0)
    seen: list[int] = []
    for time_ns in range(WINDOW // IN_FLIGHT):
        for frame in server.poll(time_ns):
            server.broadcast(time_ns, 4, frame)
            seen.append(frame.data[0])
    assert seen == list(range(WINDOW)) and server.malformed == 0
    for _ in range(WINDOW):
        bus.send(message(), timeout=0)


def test_a_client_that_does_not_read_still_learns_what_became_of_its_frames(server: PortServer, bus: HilBus) -> None:
    sent = [bus.transmit(message(data=[n])) for n in range(8)]
    frames = server.poll(0)
    for n in range(2000):
        server.broadcast(n, 1, Frame(0x181, bytes(64)))
    for frame in frames:
        server.broadcast(3_000, 4, frame)
    assert server.overruns > 0
    while not all(transmission.done() for transmission in sent):
        bus.recv(0)
        server.poll(4_000)
    assert [transmission.result(0) for transmission in sent] == [3e-6] * 8


def test_a_client_says_when_it_must_be_looked_after() -> None:
    """For a server that sleeps meanwhile."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        client = Client(ours)
        assert client.next_ns() == NEVER and client.idle
        theirs.send(pack_frame(Frame(1, b""), tag=1))
        client.hear(5)
        assert client.due(5) == [Frame(1, b"")] and client.next_ns() == 5 + 10**9
        theirs.send(pack_task(2, 1000, 2500, [Frame(2, b"")]))
        client.hear(100)
        assert client.next_ns() == 100 and client.due(1200) == [Frame(2, b"")] * 2 and client.next_ns() == 2100
        assert client.due(2100) == [Frame(2, b"")] and client.next_ns() == 5 + 10**9
        while True:  # its socket is full
            missed = client.missed
            client.give(pack_frame(Frame(3, bytes(64))))
            if client.missed > missed:
                break
        assert client.landed(3000, 0, Frame(1, b"")) and client.next_ns() == 2100 + 10**6
        assert client.landed(3000, 0, Frame(2, b""))
        assert not client.idle
        while True:
            try:
                theirs.recv(100, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
        client.due(4000)
        assert kind_and_tag(theirs.recv(100)) == (OWN, 1)


def test_only_frames_from_the_port_of_the_tools_are_taken_for_theirs() -> None:
    server = PortServer("left_leg", run=RUN, port=4)
    try:
        with attached(server, receive_own_messages=True) as bus:
            bus.send(message())
            (frame,) = server.poll(0)
            server.broadcast(1, 2, frame)  # somebody else sends the same
            server.broadcast(2, 4, frame)
            received = [bus.recv(1.0), bus.recv(1.0)]
            assert [m.is_rx for m in received if m] == [True, False]
    finally:
        server.close()


def test_one_that_floods_leaves_room_for_others(server: PortServer, bus: HilBus) -> None:
    with attached(server) as flooding:
        for n in range(WINDOW):
            flooding.send(message(0x7FF, data=[n]))
        for n in range(3):
            bus.send(message(0x1, data=[n]))
        frames = server.poll(0)
        assert [frame.data[0] for frame in frames if frame.id == 1] == [0, 1, 2]
        assert len(frames) == IN_FLIGHT + 3 <= QUEUE


def test_asyncio_awaits_what_becomes_of_a_frame(server: PortServer, bus: HilBus) -> None:
    async def send() -> float:
        with can.Notifier(bus, [], loop=asyncio.get_running_loop()):
            sent = bus.transmit(message())
            (frame,) = server.poll(0)
            server.broadcast(4_000, 4, frame)
            return await asyncio.wait_for(asyncio.wrap_future(sent), 5.0)

    assert asyncio.run(send()) == 4e-6


def test_what_is_under_way_when_the_emulation_ends_fails(server: PortServer, bus: HilBus) -> None:
    sent = bus.transmit(message())
    server.close()
    with pytest.raises(can.CanOperationError, match="the emulation has ended"):
        sent.result(1.0)


def test_asyncio_is_told_once_that_the_emulation_has_ended(server: PortServer, bus: HilBus) -> None:
    """A descriptor that stayed readable for ever would keep the loop busy."""
    told: list[str] = []

    async def listen() -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: told.append(str(context["exception"])))
        with can.Notifier(bus, [], loop=loop):
            server.close()
            for _ in range(100):
                await asyncio.sleep(0)

    asyncio.run(listen())
    assert told == ["the emulation has ended"]
    assert select.select([bus], [], [], 0)[0] == []
