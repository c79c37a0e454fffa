"""Ports in shared memory and on sockets, from this process and from another."""

import mmap
import os
import select
import socket
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Iterator

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.frames import CAN_FD_LENGTHS, Frame, checked
from bus.ports import PortError, PortServer, find_runs
from bus.python_can import HilBus
from bus.records import (
    FD,
    HEADER,
    REMOTE,
    VERSION,
    MalformedRecordError,
    kind_and_tag,
    pack_frame,
    unpack_frame,
)
from bus.shm_port import ShmPort

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

    def __init__(self, server: PortServer, **options: object) -> None:
        self.server, self.options = server, options

    def __enter__(self) -> HilBus:
        from concurrent.futures import ThreadPoolExecutor

        before = self.server.clients
        with ThreadPoolExecutor(1) as pool:
            opening = pool.submit(lambda: HilBus(CHANNEL, **self.options))  # type: ignore[arg-type]
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
    raw = socket.socket(fileno=os.dup(bus._socket.fileno()))
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
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(find_runs)
        while not found.done():
            server.poll()
    assert found.result()[RUN] == {
        "version": VERSION,
        "run": RUN,
        "channel": "left_leg",
        "endpoint": "tcp/127.0.0.1:1",
        "notice": None,
    }
    assert {"interface": "hil", "channel": CHANNEL} in can.detect_available_configs("hil")
