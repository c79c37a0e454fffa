"""Impairments of a bus as its receivers see them."""

import pickle
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.config import BusConfig
from bus.frames import Frame
from bus.link import NEVER
from bus.wire import Delivery, Wire
from hil.streams import streams

MS = 1_000_000


def wire(seed: int = 1, **values: Any) -> Wire:
    return Wire("leg", BusConfig.model_validate(values), 4, streams(seed))


def sent(one: Wire, n: int) -> list[Delivery]:
    """What comes of ``n`` frames offered 1 ms apart, numbered by their data."""
    delivered = []
    for k in range(n):
        while one.next_ns < k * MS:
            delivered += one.advance(one.next_ns)
        one.offer(k * MS, 1, Frame(0x181, k.to_bytes(8, "little")))
    while one.next_ns != NEVER:
        delivered += one.advance(one.next_ns)
    return delivered


def numbers(delivered: list[Delivery]) -> list[int]:
    return [int.from_bytes(d.frame.data, "little") for d in delivered]


def test_the_bus_carries_a_duplicated_frame_once() -> None:
    one, clean = wire(duplicate=1.0), wire()
    twice = sent(one, 50)
    assert numbers(twice) == [k for k in range(50) for _ in range(2)]
    assert all(a.time == b.time for a, b in zip(twice[::2], twice[1::2], strict=True))
    assert twice[::2] == sent(clean, 50) and one.busy_ns == clean.busy_ns
    assert one.counts["duplicated"] == 50 and one.counts["sent"] == 50


def test_a_corrupted_frame_is_delivered_with_one_wrong_bit_and_no_bus_error() -> None:
    one = wire(corruption=1.0)
    assert all((got ^ k).bit_count() == 1 for k, got in enumerate(numbers(sent(one, 50))))
    assert one.counts["corrupted"] == 50 and one.counts["errors"] == 0


def test_a_reordered_frame_comes_right_behind_the_next() -> None:
    one = wire(reorder=1.0)  # every second: while one is held the next is not
    delivered = sent(one, 20)
    assert numbers(delivered) == [k for pair in range(0, 20, 2) for k in (pair + 1, pair)]
    assert all(a.time == b.time for a, b in zip(delivered[::2], delivered[1::2], strict=True))


@pytest.mark.parametrize("enter, leave", [(0.05, 0.25), (0.1, 0.9)])
def test_bursts_take_whole_runs_of_frames(enter: float, leave: float) -> None:
    one = wire(burst={"enter": enter, "leave": leave})
    n = 3000
    got = set(numbers(sent(one, n)))
    missing = [k for k in range(n) if k not in got]
    assert one.counts["lost"] == len(missing) == pytest.approx(n * enter / (enter + leave), rel=0.3)
    bursts = sum(k - 1 not in missing for k in missing)
    assert len(missing) / bursts == pytest.approx(1 / leave, rel=0.2)


@given(st.integers(0, 1000), st.integers(0, 80))
@settings(max_examples=30, deadline=None)
def test_a_restored_wire_with_every_impairment_continues_identically(seed: int, steps: int) -> None:
    def loaded() -> Wire:
        return wire(
            seed, delay="50us", jitter="200us", jitter_shape="pareto", loss=0.1, bit_error_rate=1e-3,
            corruption=0.2, duplicate=0.3, reorder=0.3, burst={"enter": 0.1},
        )  # fmt: skip

    def run(one: Wire) -> list[Delivery]:
        delivered = []
        while one.next_ns != NEVER:
            delivered += one.advance(one.next_ns)
        return delivered

    one = loaded()
    for n in range(40):
        one.offer(0, n % 4, Frame(0x100 + 7 * n % 40, bytes([n]) * 8))
    for _ in range(steps):
        if one.next_ns == NEVER:
            break
        one.advance(one.next_ns)
    saved = pickle.loads(pickle.dumps(one.snapshot()))
    expected = run(one), one.snapshot()
    other = loaded()
    other.offer(3, 1, Frame(1, b""))
    other.restore(saved)
    assert (run(other), other.snapshot()) == expected
