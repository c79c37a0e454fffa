"""Ports in shared memory."""

import mmap
import os
import struct
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.frames import Frame, checked
from bus.python_can import HilBus
from bus.shm_port import ShmPort
from tests.support.ports import frames


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
