"""Ports in shared memory and on sockets, from this process and from another."""

import asyncio
import mmap
import os
import select
import socket
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.can_messages import to_frame, to_message
from bus.frames import CAN_FD_LENGTHS, ErrorFrame, Frame, checked
from bus.link import NEVER
from bus.periodic import Task
from bus.port_client import IN_FLIGHT, WINDOW, Client
from bus.ports import PortError, PortServer, find_runs
from bus.python_can import HilBus
from bus.records import (
    FD,
    FLUSH,
    HEADER,
    OWN,
    REMOTE,
    VERSION,
    MalformedRecordError,
    kind_and_tag,
    pack_frame,
    pack_note,
    pack_task,
    unpack_frame,
)
from bus.shm_port import ShmPort
from bus.wire import QUEUE

RUN = f"test-{os.getpid()}"
CHANNEL = f"{RUN}/left_leg"


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended, fd = draw(st.booleans()), draw(st.booleans())
    length = draw(st.sampled_from(CAN_FD_LENGTHS if fd else range(9)))
    data = draw(st.binary(min_size=length, max_size=length))
    return Frame(
        draw(st.integers(0, 2 ** (29 if extended else 11) - 1)),
        bytes(length) if (remote := not fd and draw(st.booleans())) else data,
        fd,
        fd and draw(st.booleans()),
        extended,
        remote,
        fd and draw(st.booleans()),
    )


@pytest.fixture
def server() -> Iterator[PortServer]:
    server = PortServer("left_leg", run=RUN, endpoint="tcp/127.0.0.1:1")
    yield server
    server.close()


@pytest.fixture
def bus(server: PortServer) -> Iterator[HilBus]:
    with attached(server) as bus:
        yield bus


class attached:
    """A bus that attaches while the server polls: its greeting comes with the poll."""

    def __init__(self, server: PortServer, channel: str = CHANNEL, **options: object) -> None:
        self.server, self.channel, self.options = server, channel, options

    def __enter__(self) -> HilBus:
        before = self.server.clients
        with ThreadPoolExecutor(1) as pool:
            opening = pool.submit(lambda: HilBus(self.channel, **self.options))  # type: ignore[arg-type]
            while self.server.clients == before and not opening.done():
                self.server.poll()
            self.bus = opening.result()
        return self.bus

    def __exit__(self, *_: object) -> None:
        self.bus.shutdown()


# --- shared memory ---


@given(st.lists(st.one_of(frames(), st.none()), max_size=120))
def test_a_ring_is_a_bounded_queue(steps: list[Frame | None]) -> None:
    """None: the other side reads all. Against a deque."""
    memory = memoryview(mmap.mmap(-1, ShmPort.SIZE))
    ours, theirs = ShmPort(memory), ShmPort(memory, firmware=True)
    for sender, receiver in ((ours, theirs), (theirs, ours)):
        model: deque[Frame] = deque()
        for step in steps:
            if step is None:
                assert receiver.recv_frames() == list(model)
                model.clear()
            elif len(model) < 32:
                assert sender.send_frame(step)
                model.append(step)
            else:
                assert not sender.send_frame(step)
        assert receiver.recv_frames() == list(model)
        assert sender.recv_frames() == []


def test_shared_memory_carries_frames_between_processes() -> None:
    memory = mmap.mmap(-1, ShmPort.SIZE)
    port = ShmPort(memoryview(memory))
    frame = Frame(0x200, bytes(range(64)))
    port.send_frame(frame)
    child = os.fork()
    if child == 0:
        firmware = HilBus(channel="left_leg", port=ShmPort(memoryview(memory), firmware=True))
        for received in firmware.recv_frames():
            firmware.send_frame(received._replace(id=0x181))
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert port.recv_frames() == [frame._replace(id=0x181)]


@pytest.mark.parametrize("frame", [Frame(0x800, b""), Frame(1, bytes(9)), Frame(1, bytes(100)),
                                   Frame(1, b"", fd=False, brs=True)])  # fmt: skip
def test_what_no_controller_could_send_is_dropped_and_counted(frame: Frame) -> None:
    memory = memoryview(mmap.mmap(-1, ShmPort.SIZE))
    ours, theirs = ShmPort(memory), ShmPort(memory, firmware=True)
    theirs.send_frame(frame)
    theirs.send_frame(Frame(0x181, b"\x01"))
    assert ours.recv_frames() == [Frame(0x181, b"\x01")] and ours.malformed == 1


@given(st.binary(min_size=ShmPort.SIZE // 2, max_size=ShmPort.SIZE // 2))
def test_a_ring_of_arbitrary_content_gives_valid_frames_or_none(content: bytes) -> None:
    memory = memoryview(mmap.mmap(-1, ShmPort.SIZE))
    memory[ShmPort.SIZE // 2 :] = content
    memory[ShmPort.SIZE // 2 : ShmPort.SIZE // 2 + 16] = struct.pack("<qq", 40, 8 + content[0] % 40)
    for frame in ShmPort(memory).recv_frames():
        assert checked(frame) is frame


# --- records ---


@given(frames(), st.integers(0, 2**62), st.integers(0, 255))
def test_a_record_is_read_back(frame: Frame, time_ns: int, sender: int) -> None:
    assert unpack_frame(pack_frame(frame, time_ns, sender)) == (time_ns, sender, frame)


@given(st.binary(max_size=90))
def test_any_other_bytes_are_refused_or_a_record(record: bytes) -> None:
    try:
        time_ns, sender, frame = unpack_frame(record)
    except MalformedRecordError:
        return
    kind, tag = kind_and_tag(record)
    again = pack_frame(frame, time_ns, sender, kind, tag)
    assert again == record or (frame.remote and again[: HEADER.size] == record[: HEADER.size])


# --- sockets ---


def test_frames_travel_both_ways(server: PortServer, bus: HilBus) -> None:
    server.broadcast(1_500_000_001, 2, Frame(0x181, b"\x01" * 24))
    message = bus.recv(1.0)
    assert message is not None and message.timestamp == pytest.approx(1.500000001, abs=1e-12)
    assert (message.arbitration_id, bytes(message.data), message.is_fd, message.bitrate_switch) == (
        0x181, b"\x01" * 24, True, True)  # fmt: skip
    bus.send(can.Message(arbitration_id=0x1ABCDEF, data=b"\x05", is_extended_id=True))
    assert server.poll() == [Frame(0x1ABCDEF, b"\x05", fd=False, brs=False, extended=True)]


def test_filters_timeout_and_fileno(server: PortServer, bus: HilBus) -> None:
    assert bus.recv(0) is None and bus.recv(0.01) is None
    bus.set_filters([{"can_id": 0x182, "can_mask": 0x7FF}])
    for identifier in (0x181, 0x182, 0x183):
        server.broadcast(0, 1, Frame(identifier, b""))
    assert select.select([bus], [], [], 0)[0] == [bus]
    received = bus.recv(1.0)
    assert received is not None and received.arbitration_id == 0x182
    assert bus.recv(0) is None


def test_a_sender_hears_itself_only_when_it_wants_to(server: PortServer, bus: HilBus) -> None:
    with attached(server, receive_own_messages=True) as other:
        for sender, data in ((bus, b"\x01"), (other, b"\x02")):
            sender.send(can.Message(arbitration_id=0x10, is_extended_id=False, data=data))
            (frame,) = server.poll()
            server.broadcast(0, 4, frame)
        heard = bus.recv(1.0)
        assert heard is not None and bytes(heard.data) == b"\x02" and heard.is_rx
        assert bus.recv(0) is None
        both = [other.recv(1.0), other.recv(1.0)]
        assert [(bytes(m.data), m.is_rx) for m in both if m] == [(b"\x01", True), (b"\x02", False)]


def test_a_client_that_does_not_read_never_blocks_the_run(server: PortServer, bus: HilBus) -> None:
    for n in range(5000):
        server.broadcast(n, 1, Frame(0x181, bytes(64)))
    assert server.overruns > 0 and server.clients == 1
    first = bus.recv(1.0)
    assert first is not None and first.timestamp == 0.0


def test_malformed_records_are_dropped_and_counted(server: PortServer, bus: HilBus) -> None:
    raw = socket.socket(fileno=os.dup(bus._connection._socket.fileno()))
    good = pack_frame(Frame(0x181, b"\x01"))
    kinds = [good[:16] + bytes([kind]) + good[17:] for kind in (1, 2, 3, 4, 5, 7, 9, 255)]
    remote_fd = good[:17] + bytes([FD | REMOTE]) + good[18:]
    bad = [b"x", good + b"\0", good[:-1], b"\xff" * 40, bytes(17) + b"\xff" + bytes(2), b"y" * 5000, remote_fd, *kinds]
    for record in bad:
        raw.send(record)
    raw.send(good)
    raw.close()
    assert server.poll() == [Frame(0x181, b"\x01")]
    assert server.malformed == len(bad) and server.clients == 1


def test_a_client_that_leaves_is_forgotten(server: PortServer) -> None:
    with attached(server):
        assert server.clients == 1
    assert server.poll() == [] and server.clients == 0


def test_errors_are_sentences(server: PortServer, bus: HilBus) -> None:
    with pytest.raises(
        can.CanInitializationError,
        match=f"serves a bus '{RUN}/tail'; there is: .*{CHANNEL}",
    ):
        HilBus(f"{RUN}/tail")
    with pytest.raises(can.CanOperationError, match="error frames are sent by controllers"):
        bus.send(can.Message(arbitration_id=1, is_error_frame=True))
    with pytest.raises(can.CanOperationError, match="no remote frames"):
        bus.send(can.Message(arbitration_id=1, is_remote_frame=True, is_fd=True))
    with pytest.raises(can.CanOperationError, match="at most 8 bytes"):
        bus.send(can.Message(arbitration_id=1, is_remote_frame=True, dlc=9))
    with pytest.raises(can.CanOperationError, match="9 bytes"):
        bus.send(can.Message(arbitration_id=1, is_fd=True, data=bytes(9)))
    with pytest.raises(PortError, match="already"):
        PortServer("left_leg", run=RUN)
    server.close()
    with pytest.raises(can.CanOperationError, match="the emulation has ended"):
        bus.recv(1.0)
    bus.shutdown()
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.send(can.Message(arbitration_id=1))


_ATTACH = """
import sys, can
with can.Bus(interface="hil", channel=sys.argv[1]) as bus:
    options = dict(is_extended_id=False, is_fd=True, bitrate_switch=True)
    bus.send(can.Message(arbitration_id=0x201, data=bytes(12), **options))
    message = bus.recv(10.0)
    print(f"{message.timestamp:.9f} {message.arbitration_id:x} {message.data.hex()}")
"""


def test_attaching_from_another_process_by_name(server: PortServer) -> None:
    process = subprocess.Popen([sys.executable, "-c", _ATTACH, CHANNEL], stdout=subprocess.PIPE, text=True)
    received: list[Frame] = []
    while not received and process.poll() is None:
        received = server.poll()
    server.broadcast(2_000_000_003, 1, Frame(0x181, b"\xab\xcd"))
    output, _ = process.communicate(timeout=20)
    assert received == [Frame(0x201, bytes(12))]
    assert output.split() == ["2.000000003", "181", "abcd"]


def test_runs_are_found_with_their_endpoint(server: PortServer) -> None:
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(find_runs)
        while not found.done():
            server.poll()
    assert found.result()[RUN] == {
        "version": VERSION,
        "run": RUN,
        "channel": "left_leg",
        "endpoint": "tcp/127.0.0.1:1",
    }
    assert {"interface": "hil", "channel": CHANNEL} in can.detect_available_configs("hil")


# --- what becomes of a frame ---


def message(identifier: int = 0x10, **options: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, **options)


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


# --- errors and state ---


def test_error_frames_arrive_as_from_socketcan(server: PortServer, bus: HilBus) -> None:
    """Whatever the filters are, as python-can's SocketCAN interface sets CAN_RAW_ERR_FILTER to all classes."""
    bus.set_filters([{"can_id": 0x182, "can_mask": 0x7FF}])
    with attached(server, ignore_rx_error_frames=True) as deaf:
        server.broadcast_error(1_500, ErrorFrame(0x88, bytes.fromhex("0000040800000809")), 2)
        server.broadcast(2_000, 1, Frame(0x182, b""))
        error = bus.recv(1.0)
        assert error is not None and error.is_error_frame and not error.is_extended_id and not error.is_fd
        assert (error.arbitration_id, error.data.hex(), error.dlc) == (0x88, "0000040800000809", 8)
        assert error.timestamp == pytest.approx(1.5e-6, abs=1e-15)
        for one in (bus, deaf):
            received = one.recv(1.0)
            assert received is not None and received.arbitration_id == 0x182


def test_state_and_error_counters_are_the_controllers(server: PortServer, bus: HilBus) -> None:
    assert (bus.state, bus.error_counters) == (can.BusState.ACTIVE, (0, 0))
    for tec, rec, number, state in ((96, 0, 0, can.BusState.ACTIVE), (128, 3, 1, can.BusState.PASSIVE),
                                    (256, 0, 2, can.BusState.ERROR), (0, 0, 0, can.BusState.ACTIVE)):  # fmt: skip
        server.set_state(tec, rec, number)
        server.poll()
        assert (bus.state, bus.error_counters) == (state, (tec, rec))
    server.set_state(130, 7, 1)
    with attached(server) as late:
        assert (late.state, late.error_counters) == (can.BusState.PASSIVE, (130, 7))


def test_a_port_that_only_listens_does_not_send(server: PortServer, bus: HilBus) -> None:
    bus.state = can.BusState.PASSIVE
    assert bus.state is can.BusState.PASSIVE
    with pytest.raises(can.CanOperationError, match="only listens"):
        bus.send(message())
    with pytest.raises(ValueError, match=r"BusState\.ACTIVE"):
        bus.state = can.BusState.ERROR
    bus.state = can.BusState.ACTIVE
    bus.send(message())
    assert len(server.poll()) == 1


def test_the_notice_is_given_once_and_with_the_first_frame(caplog: pytest.LogCaptureFixture) -> None:
    server = PortServer("left_leg", run=RUN, notice="this changes everything")
    try:
        with attached(server) as bus:
            bus.recv(0)
            assert caplog.messages == [] and server.first_sender is None
            bus.send(message())
            bus.send(message())
            server.poll()
            assert caplog.messages == [f"hil {CHANNEL}: this changes everything"]
            assert server.first_sender == os.getpid()
    finally:
        server.close()


# --- periodic sending ---


def test_periodic_sending_goes_by_bus_time(server: PortServer, bus: HilBus) -> None:
    """Looked after every 0.3 ms of bus time: each frame goes out at the first look not before it is due."""
    messages = [message(data=[n]) for n in range(2)]
    server.poll(50_000)
    task = bus.send_periodic(messages, 0.001, 0.0045)
    sent = [(now, frame.data[0]) for now in range(100_000, 10**7, 300_000) for frame in server.poll(now)]
    assert [number for _, number in sent] == [0, 1, 0, 1, 0]
    for n, (now, _) in enumerate(sent):
        assert 0 <= now - 100_000 - n * 10**6 < 300_000
    task.start()
    assert [frame.data[0] for frame in server.poll(10**7)] == [0]
    task.modify_data([message(data=[7]), message(data=[8])])
    assert [f.data[0] for now in (10**7 + 10**6, 10**7 + 2 * 10**6) for f in server.poll(now)] == [8, 7]
    task.stop()
    assert server.poll(10**8) == []


def test_periodic_frames_that_find_no_place_are_left_out(server: PortServer, bus: HilBus) -> None:
    bus.send_periodic(message(), 1e-6)
    server.poll(0)
    assert len(server.poll(10**6)) == IN_FLIGHT - 1
    assert server.poll(2 * 10**6) == []
    for n in range(WINDOW):
        bus.send(message(0x11, data=[n]))
    server.poll(3 * 10**6)
    assert server.malformed == 0


def test_periodic_sending_ends_with_its_client(server: PortServer) -> None:
    with attached(server) as bus:
        bus.send_periodic(message(), 0.001, store_task=False)
        assert len(server.poll(0)) == 1
    server.poll(10**9)
    assert server.poll(2 * 10**9) == []


def test_impossible_periodic_tasks_are_refused(server: PortServer, bus: HilBus) -> None:
    with pytest.raises(ValueError, match="at least 1 ns"):
        bus.send_periodic(message(), 0.0)
    with pytest.raises(ValueError, match="at most 32"):
        bus.send_periodic([message()] * 33, 0.1)
    with pytest.raises(can.CanOperationError, match="9 bytes"):
        bus.send_periodic(message(is_fd=True, data=bytes(9)), 0.1)


@given(st.integers(0, 10**6), st.integers(1, 10**4), st.integers(-1, 10**5), st.lists(st.integers(1, 10**4)),
       st.integers(1, 4))  # fmt: skip
def test_a_task_is_due_as_arithmetic_says(start: int, period: int, duration: int, steps: list[int], count: int) -> None:
    frames = [Frame(n, b"") for n in range(count)]
    task, now, k = Task(start, period, duration, frames), start, 0
    for step in [0, *steps]:
        now += step
        expected = []
        while start + k * period <= now and (duration < 0 or k * period < duration):
            expected.append(frames[k % count])
            k += 1
        assert task.due(now) == expected[:32]
        assert task.finished == (duration >= 0 and k * period >= duration)


# --- untrusted bytes ---


@given(st.lists(st.one_of(st.binary(max_size=200), frames().map(pack_frame), st.tuples(
    st.binary(min_size=16, max_size=16), st.integers(0, 9), st.binary(min_size=3, max_size=80),
).map(lambda parts: parts[0] + bytes([parts[1]]) + parts[2])), max_size=30))  # fmt: skip
@settings(deadline=None, max_examples=60)
def test_a_server_takes_any_records(records: list[bytes]) -> None:
    """It never fails, hands over only what a controller could send, and goes on serving."""
    server = PortServer("fuzz", run=RUN)
    try:
        raw = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        raw.connect(f"\0hume-hil/{os.getuid()}/{RUN}/fuzz")
        with raw:
            for now, record in enumerate(records):
                raw.send(record or b"x")  # nothing would mean that it leaves
                for frame in server.poll(now * 10**6):
                    assert checked(frame) is frame
                    server.broadcast(now * 10**6, 1, frame)
            raw.send(pack_note(FLUSH))
            server.poll(10**12)
            raw.send(pack_frame(Frame(0x123, b"\x01"), tag=7))
            handed = [frame for step in range(9) for frame in server.poll((2000 + step) * 10**9)]
            assert Frame(0x123, b"\x01") in handed
        server.poll(10**14)
        assert server.clients == 0
    finally:
        server.close()


@given(st.lists(st.one_of(st.binary(min_size=1, max_size=100), frames().map(pack_frame), st.tuples(
    st.binary(min_size=16, max_size=16), st.integers(0, 9), st.binary(min_size=3, max_size=80),
).map(lambda parts: parts[0] + bytes([parts[1]]) + parts[2])), max_size=30))  # fmt: skip
@settings(deadline=None, max_examples=60)
def test_a_client_takes_any_records(records: list[bytes]) -> None:
    server = PortServer("fuzz", run=RUN)
    try:
        with attached(server, channel=f"{RUN}/fuzz") as bus:
            (client,) = server._clients
            for record in records:
                client.socket.send(record)
                received = bus.recv(0)
                assert received is None or isinstance(received, can.Message)
            while bus.recv(0) is not None:
                pass
            server.broadcast(5, 1, Frame(0x123, b"\x01"))
            last = bus.recv(1.0)
            assert last is not None and (last.arbitration_id, last.timestamp) == (0x123, 5e-9)
            assert bus.state in can.BusState
    finally:
        server.close()


def test_not_more_clients_than_it_can_serve(server: PortServer) -> None:
    address = f"\0hume-hil/{os.getuid()}/{CHANNEL}"
    connections = []
    for _ in range(70):
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        connection.connect(address)
        connections.append(connection)
        server.poll()
    assert server.clients == 64
    for connection in connections:
        connection.close()
    server.poll()
    assert server.clients == 0


@given(frames(), st.integers(0, 10**15))
def test_frames_and_messages_are_two_forms_of_one_thing(frame: Frame, time_ns: int) -> None:
    message = to_message(frame, time_ns, "x")
    message._check()
    assert to_frame(message) == frame and round(message.timestamp * 1e9) == time_ns
