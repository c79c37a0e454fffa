"""A node is taken off the wire, and another put in its place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from bus.config import BusConfig
from bus.confinement import State
from bus.frames import Frame
from bus.link import NEVER
from bus.wire import Delivery, Wire
from hil.streams import streams

BIT_NS = 1000  # at the arbitration rate
PORTS = 3


def wire(**config: Any) -> Wire:
    return Wire("lab", BusConfig(**config), PORTS, streams(0))


def run(one: Wire, until_ns: int = NEVER - 1) -> list[Delivery]:
    """All that is delivered by ``until_ns``."""
    delivered = []
    while (due := one.next_ns) <= until_ns:
        delivered += one.advance(due)
    return delivered


@pytest.mark.parametrize("queue", ["priority", "fifo"])
def test_what_it_was_to_send_is_given_up_and_its_faults_go(queue: str) -> None:
    one = wire(queue=queue)
    for fault in (one.cut, one.listen_only, one.one_shot):
        fault(0, True, 0)
    one.bit_rate_error(0, 1.5, 0)
    frames = [Frame(identifier, b"") for identifier in (0x30, 0x10, 0x20)]
    for frame in frames:
        one.offer(0, 0, frame)
    assert run(one) == [] and one.waiting(0) == 3
    assert one.unplug(0, 1_000_000)
    assert one.waiting(0) == 0 and sorted(one.given_up()) == sorted((0, frame) for frame in frames)
    assert one.given_up() == [] and one.dropped == 3
    one.offer(1_000_000, 0, frames[0])
    assert [(d.sender, d.frame, d.missed) for d in run(one)] == [(0, frames[0], 0)]
    one.offer(2_000_000, 1, frames[1])
    assert [(d.sender, d.frame, d.missed) for d in run(one)] == [(1, frames[1], 0)]
    assert [one.ports_state(port) for port in range(PORTS)] == [(0, 0, State.ERROR_ACTIVE)] * PORTS


def test_a_frame_under_way_ends_first() -> None:
    one = wire()
    one.offer(0, 0, Frame(0x10, b""))
    one.offer(0, 0, Frame(0x20, b""))
    one.advance(0)
    assert not one.unplug(0, 5 * BIT_NS)
    assert [d.frame.id for d in run(one)] == [0x10]
    assert [frame.id for _, frame in one.given_up()] == [0x20]
    assert one.unplug(0, 1_000_000)


def test_a_frame_under_way_that_fails_is_not_sent_again() -> None:
    one = wire()
    one.damage(0x10, 1, "crc:3")
    one.offer(0, 0, Frame(0x10, b""))
    one.advance(0)
    assert not one.unplug(0, 5 * BIT_NS)
    assert run(one) == []
    assert one.errors == 1 and one.given_up() == [(0, Frame(0x10, b""))] and one.waiting(0) == 0


def test_the_bus_is_free_11_bits_after_a_stuck_node_is_gone() -> None:
    one = wire()
    one.stuck_dominant(0, True, 0)
    one.offer(0, 1, Frame(0x10, b""))
    assert run(one, 10_000_000) == [] and one.next_ns == NEVER
    assert one.unplug(0, 20_000_000)
    assert one.next_ns == 20_000_000 + 11 * BIT_NS
    assert [d.frame.id for d in run(one)] == [0x10]


@pytest.mark.parametrize("when", ["before a frame", "in a frame"])
def test_the_next_node_has_a_controller_of_its_own(when: str) -> None:
    """Also if the node is replaced while a frame of another is under way, whose outcome the wire knows beforehand."""
    one = wire(bus_off_recovery="request")
    for n in range(1, 40):
        one.damage(0x10, n, "crc:3")
    one.offer(0, 0, Frame(0x10, b""))
    run(one)
    assert one.ports_state(0).state is State.BUS_OFF
    assert one.ports_state(1) == (0, 32, State.ERROR_ACTIVE)
    start = 50_000_000
    one.unplug(0, start)  # bus off, with a frame that it cannot send any more
    if when == "in a frame":
        one.offer(start, 2, Frame(0x30, b""))
        one.advance(start)
    assert one.unplug(1, start + 5 * BIT_NS)
    run(one)
    assert [one.ports_state(port)[:2] for port in (0, 1)] == [(0, 0), (0, 0)]
    one.offer(2 * start, 0, Frame(0x20, b""))
    assert [(d.sender, d.missed) for d in run(one)] == [(0, 0)]


def test_it_is_part_of_a_snapshot() -> None:
    one, other = wire(), wire()
    one.damage(0x10, 1, "crc:3")
    one.offer(0, 0, Frame(0x10, b""))
    one.offer(0, 0, Frame(0x20, b""))
    one.advance(0)
    one.unplug(0, 5 * BIT_NS)
    other.restore(one.snapshot())
    ends: Callable[[Wire], Any] = lambda w: (run(w), w.given_up(), w.snapshot())  # noqa: E731
    assert ends(other) == ends(one)


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match="bus lab has no port 3: expected 0 to 2"):
        wire().unplug(3, 0)
