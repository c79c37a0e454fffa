"""Periodic sending in bus time."""


import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.frames import Frame
from bus.periodic import Task
from bus.port_client import IN_FLIGHT, WINDOW
from bus.ports import PortServer
from bus.python_can import HilBus
from tests.support.ports import attached, message


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
