"""Ports on sockets: attaching, hearing, errors and state."""

import os
import select
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import can
import pytest

from bus.frames import ErrorFrame, Frame
from bus.ports import PortError, PortServer, find_runs
from bus.python_can import HilBus
from bus.records import (
    FD,
    REMOTE,
    VERSION,
    pack_frame,
)
from tests.support.ports import CHANNEL, RUN, attached, message


def test_frames_travel_both_ways(server: PortServer, bus: HilBus) -> None:
    server.broadcast(1_500_000_001, 2, Frame(0x181, b"\x01" * 24))
    message = bus.recv(1.0)
    assert message is not None and message.timestamp == pytest.approx(1.500000001, abs=1e-12)
    assert (message.arbitration_id, bytes(message.data), message.is_fd, message.bitrate_switch) == (
        0x181, b"\x01" * 24, True, True)  # fmt: skip
    bus.send(can.Message(arbitration_id=0x1ABCDEF, data=b"\x05", is_extended_id=True))
    assert server.poll() == [Frame(0x1ABCDEF, b"\x05", fd=False, brs=False, extended=True)]


def test_filters_timeout_and_fileno(server: PortServer, bus: HilBus) -> None:
    assert bus.recv(0) is None and bus.recv(0.01) is None and bus.recv(-1.0) is None
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
    for tec, rec, number, state in ((96, 0, 1, can.BusState.ACTIVE), (128, 3, 2, can.BusState.PASSIVE),
                                    (256, 0, 3, can.BusState.ERROR), (0, 0, 0, can.BusState.ACTIVE)):  # fmt: skip
        server.set_state(tec, rec, number)
        server.poll()
        assert (bus.state, bus.error_counters) == (state, (tec, rec))
    server.set_state(130, 7, 2)
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
