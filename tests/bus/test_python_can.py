"""python-can's own interface over a port in shared memory, as the firmware has it."""

import can
import pytest

from bus.frames import Frame
from bus.ports import PortError, PortServer, served
from bus.python_can import HilBus
from bus.shm_port import ShmPort


@pytest.fixture
def ends() -> tuple[ShmPort, ShmPort]:
    memory = memoryview(bytearray(ShmPort.SIZE))
    return ShmPort(memory), ShmPort(memory, firmware=True)


def test_messages_pass_in_both_directions(ends: tuple[ShmPort, ShmPort]) -> None:
    wire, firmware = ends
    with HilBus("left_leg", port=firmware) as bus:
        assert bus.recv(None) is None  # nothing can come while a node runs: it must not wait
        sent = [Frame(0x200, bytes(64)), Frame(0x1FFFFFFF, b"\x01", False, False, True)]
        for frame in sent:
            wire.send_frame(frame)
        received = [bus.recv(), bus.recv()]
        assert [
            Frame(m.arbitration_id, bytes(m.data), m.is_fd, m.bitrate_switch, m.is_extended_id)
            for m in received
            if m is not None
        ] == sent
        bus.send(can.Message(arbitration_id=0x181, is_extended_id=False, is_fd=True, data=bytes(24)))
        assert wire.recv_frames() == [Frame(0x181, bytes(24), brs=False)]
        assert wire.recv_frames() == [] and bus.recv() is None


def test_filters_apply(ends: tuple[ShmPort, ShmPort]) -> None:
    wire, firmware = ends
    bus = HilBus("left_leg", port=firmware, can_filters=[{"can_id": 0x200, "can_mask": 0x7FF}])
    for identifier in (0x181, 0x200, 0x182):
        wire.send_frame(Frame(identifier, b""))
    message = bus.recv()
    assert message is not None and message.arbitration_id == 0x200
    assert bus.recv() is None
    assert bus.fileno() == -1


def test_a_full_ring_is_an_error(ends: tuple[ShmPort, ShmPort]) -> None:
    bus = HilBus("left_leg", port=ends[1])
    message = can.Message(arbitration_id=1, is_extended_id=False)
    with pytest.raises(can.CanOperationError, match="full"):
        for _ in range(1000):
            bus.send(message)
    ends[0].recv_frames()
    bus.send(message)


def test_a_name_too_long_for_an_address_is_not_called_taken() -> None:
    with pytest.raises(PortError, match="cannot be served"):
        PortServer("left_leg", run="r" * 200)


def test_a_channel_of_two_runs_must_be_named_in_full() -> None:
    servers = [PortServer("twin_leg", run=name) for name in ("twin-a", "twin-b")]
    try:
        assert {("twin-a", "twin_leg"), ("twin-b", "twin_leg")} <= set(served())
        with pytest.raises(can.CanInitializationError, match="twin-a/twin_leg, twin-b/twin_leg"):
            HilBus("twin_leg")
    finally:
        for server in servers:
            server.close()
    assert ("twin-a", "twin_leg") not in served()
    with pytest.raises(can.CanInitializationError, match="no running emulation"):
        HilBus("twin_leg")
