"""The wire: to the nanosecond, arbitration against sorting, errors and retransmission, restoring."""

import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.config import BusConfig
from bus.frames import Frame, InvalidFrameError
from bus.link import NEVER
from bus.timing import INTERMISSION, TAIL, BitRates, frame_bits, frame_ns
from bus.wire import QUEUE, Delivery, Wire
from hil.streams import streams

BIT = 1000  # ns, arbitration


def wire(seed: int = 1, ports: int = 5, **values: object) -> Wire:
    return Wire("leg", BusConfig.model_validate(values), ports, streams(seed))


def run(one: Wire, until: int = NEVER - 1) -> list[Delivery]:
    delivered = []
    while one.next_time() <= until:
        delivered += one.advance(one.next_time())
    return delivered


def duration(frame: Frame) -> int:
    """Start of frame to end of EOF."""
    return frame_ns(frame, 1e6, 5e6) - INTERMISSION * BIT


def test_a_frame_arrives_after_its_duration_and_not_a_nanosecond_before() -> None:
    one, frame = wire(), Frame(0x181, bytes(range(24)))
    assert one.next_time() == NEVER
    one.offer(5_000, 1, frame)
    assert one.next_time() == 5_000
    assert one.advance(5_000) == []
    end = 5_000 + duration(frame)
    assert one.next_time() == end
    assert one.advance(end - 1) == []
    assert one.advance(end) == [Delivery(end, 1, frame)]
    assert one.next_time() == NEVER
    assert (one.sent, one.errors, one.lost) == (1, 0, 0)
    assert one.busy_ns == frame_ns(frame, 1e6, 5e6)


def test_the_next_frame_starts_after_the_intermission() -> None:
    one, first, second = wire(), Frame(0x100, b"\x55" * 8), Frame(0x101, b"\x55" * 8)
    one.offer(0, 0, first)
    one.advance(0)
    end = duration(first)
    one.offer(end - 10, 1, second)
    assert one.next_time() == end
    one.advance(end)
    one.offer(end + 1, 2, Frame(0x102, b""))  # within the intermission: waits for its end, and loses there
    assert one.next_time() == end + 3 * BIT
    delivered = run(one)
    assert [d.frame.id for d in delivered] == [0x101, 0x102]
    assert delivered[0].time == end + 3 * BIT + duration(second)


payloads = st.sampled_from([b"", b"\x01" * 8, bytes(24), b"\xaa" * 64])
frames = st.tuples(st.integers(0, 0x7FF), payloads).map(lambda f: Frame(*f))


@given(st.lists(st.tuples(st.integers(0, 4), frames), min_size=1, max_size=QUEUE))
def test_frames_offered_at_once_go_by_identifier_port_and_order(offers: list[tuple[int, Frame]]) -> None:
    one = wire()
    for port, frame in offers:
        one.offer(0, port, frame)
    delivered = run(one)
    expected = sorted(offers, key=lambda o: (o[1].id, o[0]))  # a stable sort: ties keep the order of offering
    assert [(d.sender, d.frame) for d in delivered] == expected
    now = 0
    for d in delivered:
        assert d.time == now + duration(d.frame)
        now = d.time + 3 * BIT
    waits = one.waits()
    assert sum(w.frames for w in waits.values()) == len(offers)
    last_started = now - frame_ns(expected[-1][1], 1e6, 5e6)
    assert max(w.longest for w in waits.values()) == one.longest_wait_ns == last_started
    assert all(w.shortest <= w.mean <= w.longest for w in waits.values())


@given(st.integers(0, 2**29 - 1), st.integers(0, 2**11 - 1), st.integers(0, 2**29 - 1))
def test_arbitration_compares_the_bits_as_they_are_sent(a: int, b: int, c: int) -> None:
    def sent_bits(frame: Frame) -> str:  # dominant 0 wins; RTR of base and SRR, IDE of extended frames
        if frame.extended:
            return f"{frame.id >> 18:011b}11{frame.id & 0x3FFFF:018b}0"
        return f"{frame.id:011b}00"

    long, short = (Frame(i, b"", extended=True) for i in (a, c)), (Frame(i, b"") for i in (b, a >> 18))
    contenders = [*long, *short]
    one = wire()
    for port, frame in enumerate(contenders):
        one.offer(0, port, frame)
    expected = sorted(enumerate(contenders), key=lambda o: (sent_bits(o[1]), o[0]))
    assert [d.frame for d in run(one)] == [frame for _, frame in expected]


def test_equal_identifiers_of_two_ports_are_counted() -> None:
    one = wire()
    one.offer(0, 3, Frame(0x10, b"\x03"))
    one.offer(0, 2, Frame(0x10, b"\x02"))
    assert [d.sender for d in run(one)] == [2, 3]
    assert one.collisions == 1


def test_a_frame_under_way_is_not_interrupted_by_a_higher_priority() -> None:
    one = wire()
    one.offer(0, 0, Frame(0x700, bytes(64)))
    one.advance(0)
    one.offer(1, 1, Frame(0x001, b""))
    assert [d.frame.id for d in run(one)] == [0x700, 0x001]


def test_a_damaged_frame_is_followed_by_an_error_frame_and_sent_again() -> None:
    one, frame = wire(bit_error_rate=1.0), Frame(0x181, bytes(24))  # every first bit is damaged
    one.offer(0, 1, frame)
    one.offer(0, 1, frame._replace(data=b"\x01" * 24))  # of the same identifier: must not overtake
    one.advance(0)
    assert one.next_time() == BIT
    assert one.advance(BIT) == []
    assert one.errors == 1
    # flag 6, echo 6, delimiter 8, intermission 3
    restart = BIT + 23 * BIT
    assert one.next_time() == restart
    one.set("bit_error_rate", 0.0)
    delivered = run(one)
    assert delivered[0] == Delivery(restart + duration(frame), 1, frame)
    assert delivered[1].frame.data == b"\x01" * 24
    assert one.sent == 2 and one.waits()[0x181, False].shortest == restart
    assert one.busy_ns == restart + sum(frame_ns(d.frame, 1e6, 5e6) for d in delivered)


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_bit_errors_delay_frames_but_lose_none(seed: int) -> None:
    noisy = wire(seed, bit_error_rate=2e-3)
    sent = [Frame(0x180 + n, bytes([n]) * 24) for n in range(20)]
    for frame in sent:
        noisy.offer(0, 1, frame)
    delivered = run(noisy)
    assert [d.frame for d in delivered] == sent
    assert noisy.sent == 20
    clean = sum(frame_ns(frame, 1e6, 5e6) for frame in sent)
    longest = max(map(duration, sent))
    assert noisy.errors * 24 * BIT <= noisy.busy_ns - clean <= noisy.errors * (23 * BIT + longest)


@given(st.integers(0, 0x7FF), st.binary(min_size=24, max_size=24))
def test_the_time_of_a_bit_grows_to_the_duration_of_the_frame(identifier: int, data: bytes) -> None:
    frame, rates = Frame(identifier, data), BitRates(1e6, 5e6)
    bits = frame_bits(frame)
    total = bits.slow + bits.fast + TAIL - INTERMISSION
    ends = [rates.ns_until(bit, bits) for bit in range(total)]
    steps = [b - a for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    assert steps == [1000] * bits.slow + [200] * bits.fast + [1000] * (TAIL - INTERMISSION)
    assert ends[-1] == duration(frame)


def test_delay_jitter_and_loss_apply_to_deliveries_only() -> None:
    late, frame = wire(delay="1ms"), Frame(0x100, b"")
    late.offer(0, 0, frame)
    late.offer(0, 0, frame)
    first, second = run(late)
    assert first.time == 1_000_000 + duration(frame)
    assert second.time - first.time == frame_ns(frame, 1e6, 5e6)  # the bus went on meanwhile
    deaf = wire(loss=1.0)
    deaf.offer(0, 0, frame)
    assert run(deaf) == [] and (deaf.sent, deaf.lost) == (1, 1)
    shaken = wire(jitter="5ms")
    for n in range(QUEUE):
        shaken.offer(0, 0, Frame(0x100 + n, b""))
    order = [d.frame.id for d in run(shaken)]
    assert sorted(order) == [0x100 + n for n in range(QUEUE)] and order != sorted(order)


def test_a_full_transmit_queue_refuses_and_empties_again() -> None:
    one, frame = wire(), Frame(0x181, b"")
    assert all(one.offer(0, 1, frame) for _ in range(QUEUE))
    assert not one.offer(0, 1, frame)
    assert one.refused == 1
    assert one.offer(0, 2, frame)  # another port's queue is its own
    assert len(run(one)) == QUEUE + 1
    assert one.offer(10**9, 1, frame)


def test_a_restored_wire_knows_how_full_its_queues_are() -> None:
    one, frame = wire(), Frame(0x181, b"")
    for _ in range(QUEUE):
        one.offer(0, 1, frame)
    other = wire()
    other.restore(one.snapshot())
    assert not other.offer(0, 1, frame) and other.offer(0, 2, frame)
    assert one.snapshot()["queued"] == [0, QUEUE, 0, 0, 0]  # the snapshot was a copy


def test_an_impossible_frame_is_refused_where_it_is_offered() -> None:
    one = wire()
    with pytest.raises(InvalidFrameError):
        one.offer(0, 1, Frame(0x800, b""))
    assert one.next_time() == NEVER


@given(st.integers(0, 1000), st.integers(0, 60))
@settings(max_examples=40)
def test_a_restored_wire_continues_identically(seed: int, steps: int) -> None:
    def loaded(s: int) -> Wire:
        return wire(s, delay="50us", jitter="200us", loss=0.1, bit_error_rate=1e-3)

    one = loaded(seed)
    for n in range(40):
        one.offer(0, n % 5, Frame(0x100 + 7 * n % 40, bytes([n]) * 8))
    for _ in range(steps):
        if one.next_time() == NEVER:
            break
        one.advance(one.next_time())
    saved = pickle.loads(pickle.dumps(one.snapshot()))
    expected = run(one), one.snapshot()
    other = loaded(seed)
    other.offer(3, 1, Frame(1, b""))
    other.restore(saved)
    assert (run(other), other.snapshot()) == expected
