"""Two programs on one bus, through python-can alone: one suite for any interface, subclassed by class constants.

In the manner of python-can's own test/back2back_test.py. That it also passes on python-can's ``virtual`` shows that it
asks for nothing special; what an interface does not have, it says by a constant.
"""

import asyncio
import os
import select
import threading
from collections.abc import Iterator
from typing import Any, ClassVar

import can
import pytest


class Back2Back:
    """Subclasses set the constants. ``bus`` and ``other`` are two ports of one bus."""

    INTERFACE: ClassVar[str]
    CHANNEL: ClassVar[str]  # or override ``channel``
    OPTIONS: ClassVar[dict[str, Any]] = {}
    TIMEOUT: ClassVar[float] = 5.0  # for what must come
    SILENCE: ClassVar[float] = 0.05  # for what must not
    LATE: ClassVar[float] = 0.15  # what a loaded machine may be late, s
    COUNTS_PERIODS: ClassVar[bool]  # periodic sending leaves none out on a loaded machine
    HAS_FILENO: ClassVar[bool]

    @pytest.fixture
    def channel(self) -> str:
        return self.CHANNEL

    @pytest.fixture
    def bus(self, channel: str) -> Iterator[can.BusABC]:
        with self.open(channel) as bus:
            yield bus

    @pytest.fixture
    def other(self, channel: str) -> Iterator[can.BusABC]:
        with self.open(channel) as bus:
            yield bus

    @pytest.fixture(autouse=True)
    def no_descriptor_is_left(self) -> Iterator[None]:
        before = len(os.listdir("/proc/self/fd"))
        yield
        assert len(os.listdir("/proc/self/fd")) == before

    def open(self, channel: str, **options: Any) -> can.BusABC:
        return can.Bus(interface=self.INTERFACE, channel=channel, **self.OPTIONS, **options)

    def receive(self, bus: can.BusABC) -> can.Message:
        message = bus.recv(self.TIMEOUT)
        assert message is not None
        return message

    # --- one frame ---

    @pytest.mark.parametrize("message", [
        can.Message(arbitration_id=0x123, is_extended_id=False, data=range(8)),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"\x04\x05\x06"),
        can.Message(arbitration_id=0, is_extended_id=False),
        can.Message(arbitration_id=0x1FFFFFFF, data=b"\xff" * 8),
        can.Message(arbitration_id=0x123, is_extended_id=True, data=b"\x01"),  # an extended one that looks short
        can.Message(arbitration_id=0x200, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x1ABCDEF, is_remote_frame=True, dlc=0),
        can.Message(arbitration_id=0x1ABCDEF, is_fd=True, data=range(64)),
        can.Message(arbitration_id=0x99, is_extended_id=False, is_fd=True, bitrate_switch=True, data=range(48)),
        can.Message(arbitration_id=0x99, is_extended_id=False, is_fd=True, bitrate_switch=True, data=b""),
        can.Message(arbitration_id=0x9, is_extended_id=False, is_fd=True, error_state_indicator=True, data=range(12)),
    ], ids=str)  # fmt: skip
    def test_a_message_arrives_as_it_was_sent(
        self, bus: can.BusABC, other: can.BusABC, message: can.Message
    ) -> None:
        for sender, receiver in ((bus, other), (other, bus)):
            sender.send(message)
            received = self.receive(receiver)
            assert received.equals(message, timestamp_delta=None, check_channel=False)
            assert received.is_rx

    def test_nothing_comes_when_nothing_was_sent(self, bus: can.BusABC) -> None:
        assert bus.recv(0) is None and bus.recv(self.SILENCE) is None

    def test_timestamps_are_of_one_clock_with_a_fine_resolution(self, bus: can.BusABC, other: can.BusABC) -> None:
        with self.open(bus_channel(bus)) as third:
            stamps, seen = [], []
            for n in range(20):
                bus.send(can.Message(arbitration_id=n))
                stamps.append(self.receive(other).timestamp)
                seen.append(self.receive(third).timestamp)
        assert stamps == seen and stamps == sorted(stamps) and stamps[0] < stamps[-1] < stamps[0] + self.TIMEOUT
        assert any(stamp % 1e-3 > 1e-6 for stamp in stamps)

    # --- who hears what ---

    def test_all_others_hear_a_message_and_the_sender_does_not(self, bus: can.BusABC, other: can.BusABC) -> None:
        with self.open(bus_channel(bus)) as third:
            for n, sender in enumerate((bus, other, third)):
                sender.send(can.Message(arbitration_id=n))
                for receiver in {bus, other, third} - {sender}:
                    assert self.receive(receiver).arbitration_id == n
            assert [b.recv(self.SILENCE) for b in (bus, other, third)] == [None] * 3

    def test_a_sender_hears_itself_when_it_wants_to(self, bus: can.BusABC) -> None:
        with self.open(bus_channel(bus), receive_own_messages=True) as loud:
            loud.send(can.Message(arbitration_id=5, data=b"\x01"))
            own, foreign = self.receive(loud), self.receive(bus)
            assert (own.is_rx, foreign.is_rx) == (False, True)
            assert own.equals(foreign, check_direction=False, check_channel=False)
            own.data[0] = 9  # everybody has a message of his own
            assert foreign.data[0] == 1
            bus.send(can.Message(arbitration_id=6))
            assert self.receive(loud).is_rx

    def test_filters(self, bus: can.BusABC, other: can.BusABC) -> None:
        sent = [(0x100, False), (0x101, False), (0x200, False), (0x100, True), (0x555, True)]
        for filters, expected in [
            ([{"can_id": 0x100, "can_mask": 0x7FF}], [(0x100, False), (0x100, True)]),
            ([{"can_id": 0x100, "can_mask": 0x7FE, "extended": False}], [(0x100, False), (0x101, False)]),
            ([{"can_id": 0x200, "can_mask": 0x7FF}, {"can_id": 0x555, "can_mask": 0x1FFFFFFF, "extended": True}],
             [(0x200, False), (0x555, True)]),
            (None, sent),
        ]:  # fmt: skip
            bus.set_filters(filters)
            for identifier, extended in sent:
                other.send(can.Message(arbitration_id=identifier, is_extended_id=extended))
                if (identifier, extended) in expected:  # one at a time: else arbitration would sort them
                    received = self.receive(bus)
                    assert (received.arbitration_id, received.is_extended_id) == (identifier, extended)
            assert bus.recv(self.SILENCE) is None

    def test_messages_of_one_identifier_keep_their_order(self, bus: can.BusABC, other: can.BusABC) -> None:
        def send() -> None:
            for n in range(500):
                bus.send(can.Message(arbitration_id=0x10, data=n.to_bytes(2, "big")))

        sender = threading.Thread(target=send)
        sender.start()
        received = [int.from_bytes(self.receive(other).data, "big") for _ in range(500)]
        sender.join()
        assert received == list(range(500))

    def test_many_threads_may_send_and_receive(self, bus: can.BusABC, other: can.BusABC) -> None:
        """Each on its own; a sender waits rather than that a message is lost."""
        received: list[int] = []

        def send(k: int) -> None:
            for n in range(50):
                bus.send(can.Message(arbitration_id=k, data=bytes([k, n])))

        def receive() -> None:
            for _ in range(100):
                received.append(int.from_bytes(self.receive(other).data, "big"))

        threads = [threading.Thread(target=send, args=(k,)) for k in range(8)]
        threads += [threading.Thread(target=receive) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(received) == [k << 8 | n for k in range(8) for n in range(50)]

    # --- periodic sending ---

    def test_periodic_messages_come_in_turn_and_in_time(self, bus: can.BusABC, other: can.BusABC) -> None:
        messages = [can.Message(arbitration_id=0x50, data=[n]) for n in range(3)]
        task = bus.send_periodic(messages, 0.05)
        received = [self.receive(other) for _ in range(12)]
        task.stop()
        assert [m.data[0] for m in received] == [0, 1, 2] * 4
        start = received[0].timestamp
        for n, message in enumerate(received):
            assert message.timestamp - start == pytest.approx(0.05 * n, abs=self.LATE)

    @pytest.mark.parametrize("period, duration, count", [(0.01, 0.055, 6), (0.05, 0.01, 1)])
    def test_periodic_sending_ends_after_its_duration(
        self, bus: can.BusABC, other: can.BusABC, period: float, duration: float, count: int
    ) -> None:
        bus.send_periodic(can.Message(arbitration_id=1), period, duration)
        received = 0
        while other.recv(self.LATE if received else self.TIMEOUT) is not None:
            received += 1
        assert received == count if self.COUNTS_PERIODS else 1 <= received <= count

    def test_a_periodic_task_is_changed_stopped_and_started_again(self, bus: can.BusABC, other: can.BusABC) -> None:
        task: Any = bus.send_periodic(can.Message(arbitration_id=1, data=b"\x01"), 0.005)
        assert self.receive(other).data[0] == 1
        task.modify_data(can.Message(arbitration_id=1, data=b"\x02"))
        while self.receive(other).data[0] == 1:
            pass
        assert self.receive(other).data[0] == 2
        with pytest.raises(ValueError):
            task.modify_data(can.Message(arbitration_id=2, data=b"\x02"))
        task.stop()
        while other.recv(self.SILENCE) is not None:
            pass
        task.start()
        assert self.receive(other).data[0] == 2
        task.stop()
        while other.recv(self.SILENCE) is not None:
            pass

    def test_all_periodic_tasks_are_stopped_together(self, bus: can.BusABC, other: can.BusABC) -> None:
        for identifier in (1, 2):
            bus.send_periodic(can.Message(arbitration_id=identifier), 0.005)
        assert {self.receive(other).arbitration_id for _ in range(50)} == {1, 2}
        bus.stop_all_periodic_tasks()
        while other.recv(self.SILENCE) is not None:
            pass

    def test_data_may_be_made_for_each_periodic_message(self, bus: can.BusABC, other: can.BusABC) -> None:
        def count(message: can.Message) -> None:
            message.data[0] += 1

        task = bus.send_periodic(can.Message(arbitration_id=1, data=b"\x00"), 0.005, modifier_callback=count)
        assert [self.receive(other).data[0] for _ in range(5)] == [1, 2, 3, 4, 5]
        task.stop()
        task.thread.join()  # type: ignore[attr-defined]

    # --- python-can's machinery ---

    def test_a_notifier_hands_messages_to_listeners(self, bus: can.BusABC, other: can.BusABC) -> None:
        reader = can.BufferedReader()
        with can.Notifier(bus, [reader], timeout=0.1):
            for n in range(10):
                other.send(can.Message(arbitration_id=7, data=[n]))
            read = [reader.get_message(self.TIMEOUT) for _ in range(10)]
        assert [m.data[0] for m in read if m is not None] == list(range(10))

    def test_asyncio(self, bus: can.BusABC, other: can.BusABC) -> None:
        async def echo() -> list[int]:
            reader = can.AsyncBufferedReader()
            notifier = can.Notifier(bus, [reader], timeout=0.1, loop=asyncio.get_running_loop())
            try:
                for n in range(10):
                    other.send(can.Message(arbitration_id=7, data=[n]))
                read = [(await asyncio.wait_for(reader.get_message(), self.TIMEOUT)).data[0] for _ in range(10)]
            finally:
                notifier.stop()
            return read

        assert asyncio.run(echo()) == list(range(10))

    def test_fileno_is_readable_with_a_message(self, bus: can.BusABC, other: can.BusABC) -> None:
        if not self.HAS_FILENO:
            with pytest.raises(NotImplementedError):
                bus.fileno()
            return
        other.send(can.Message(arbitration_id=7))
        assert select.select([bus], [], [], self.TIMEOUT)[0] == [bus]
        assert self.receive(bus).arbitration_id == 7

    def test_iterating_receives(self, bus: can.BusABC, other: can.BusABC) -> None:
        for n in range(3):
            other.send(can.Message(arbitration_id=7, data=[n]))
        messages = iter(bus)
        assert [next(messages).data[0] for _ in range(3)] == [0, 1, 2]

    def test_a_thread_safe_bus(self, channel: str, other: can.BusABC) -> None:
        with can.ThreadSafeBus(interface=self.INTERFACE, channel=channel, **self.OPTIONS) as bus:
            bus.send(can.Message(arbitration_id=7))
            assert self.receive(other).arbitration_id == 7

    def test_state_is_active(self, bus: can.BusABC) -> None:
        assert bus.state is can.BusState.ACTIVE

    def test_after_shutdown_nothing_works_and_shutdown_does(self, bus: can.BusABC) -> None:
        bus.shutdown()
        bus.shutdown()
        for use in (lambda: bus.send(can.Message()), lambda: bus.recv(0)):
            with pytest.raises(can.CanOperationError):
                use()

    def test_what_was_sent_before_shutdown_arrives(self, channel: str, other: can.BusABC) -> None:
        with self.open(channel) as bus:
            for n in range(50):
                bus.send(can.Message(arbitration_id=7, data=[n]))
        assert [self.receive(other).data[0] for _ in range(50)] == list(range(50))

    def test_it_is_found(self, bus: can.BusABC, channel: str) -> None:
        found = can.detect_available_configs(self.INTERFACE)
        assert channel in [config["channel"] for config in found]


def bus_channel(bus: can.BusABC) -> str:
    return bus.channel_id if isinstance(bus, can.interfaces.virtual.VirtualBus) else bus.channel  # type: ignore


class TestVirtual(Back2Back):
    """python-can's own bus within one process."""

    INTERFACE = "virtual"
    CHANNEL = "back2back"
    COUNTS_PERIODS = False
    HAS_FILENO = False


class TestHil(Back2Back):
    """An emulated bus in a process of its own."""

    INTERFACE = "hil"
    COUNTS_PERIODS = True
    HAS_FILENO = True

    @pytest.fixture
    def channel(self, lab: str) -> str:
        return lab

    def test_senders_wait_for_the_bus_beside_a_notifier(self, bus: can.BusABC, other: can.BusABC) -> None:
        """Whoever reads from the socket, everybody learns what is his: messages, and what became of frames."""
        reader = can.BufferedReader()
        with can.Notifier(bus, [reader], timeout=0.1):

            def send(k: int) -> None:
                for n in range(20):
                    bus.send(can.Message(arbitration_id=k, data=[n]), timeout=self.TIMEOUT)

            threads = [threading.Thread(target=send, args=(k,)) for k in range(4)]
            for thread in threads:
                thread.start()
            for n in range(50):
                other.send(can.Message(arbitration_id=0x99, data=[n]), timeout=self.TIMEOUT)
            for thread in threads:
                thread.join()
            read = [reader.get_message(self.TIMEOUT) for _ in range(50)]
        assert [m.data[0] for m in read if m is not None] == list(range(50))
        heard = [self.receive(other) for _ in range(80)]
        for k in range(4):
            assert [m.data[0] for m in heard if m.arbitration_id == k] == list(range(20))
