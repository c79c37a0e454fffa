"""The wire when all is well, and its queues: to the nanosecond, arbitration against sorting, restoring."""

import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.config import BusConfig
from bus.frames import Frame, InvalidFrameError
from bus.link import NEVER
from bus.timing import INTERMISSION, frame_ns
from bus.wire import QUEUE, Delivery, Wire
from hil.streams import streams

BIT = 1000  # ns, arbitration


def wire(seed: int = 1, ports: int = 5, **values: object) -> Wire:
    return Wire("leg", BusConfig.model_validate(values), ports, streams(seed))


def run(one: Wire, until: int = NEVER - 1) -> list[Delivery]:
    delivered = []
    while one.next_ns <= until:
        delivered += one.advance(one.next_ns)
    return delivered


def duration(frame: Frame) -> int:
    """Start of frame to end of EOF."""
    return frame_ns(frame, 1e6, 5e6) - INTERMISSION * BIT


def test_a_frame_arrives_after_its_duration_and_not_a_nanosecond_before() -> None:
    one, frame = wire(), Frame(0x181, bytes(range(24)))
    assert one.next_ns == NEVER
    one.offer(5_000, 1, frame)
    assert one.next_ns == 5_000
    assert one.advance(5_000) == []
    end = 5_000 + duration(frame)
    assert one.next_ns == end
    assert one.advance(end - 1) == []
    assert one.advance(end) == [Delivery(end, 1, frame)]
    assert one.next_ns == NEVER
    assert (one.sent, one.errors, one.lost) == (1, 0, 0)
    assert one.busy_ns == frame_ns(frame, 1e6, 5e6)


def test_the_next_frame_starts_after_the_intermission() -> None:
    one, first, second = wire(), Frame(0x100, b"\x55" * 8), Frame(0x101, b"\x55" * 8)
    one.offer(0, 0, first)
    one.advance(0)
    end = duration(first)
    one.offer(end - 10, 1, second)
    assert one.next_ns == end
    one.advance(end)
    one.offer(end + 1, 2, Frame(0x102, b""))  # within the intermission: waits for its end, and loses there
    assert one.next_ns == end + 3 * BIT
    delivered = run(one)
    assert [d.frame.id for d in delivered] == [0x101, 0x102]
    assert delivered[0].time == end + 3 * BIT + duration(second)


payloads = st.sampled_from([b"", b"\x01" * 8, bytes(24), b"\xaa" * 64])
# every port has identifiers of its own, as on a real bus
offers = st.tuples(st.integers(0, 4), st.integers(0, 0x7FF // 5 - 1), payloads).map(
    lambda o: (o[0], Frame(5 * o[1] + o[0], o[2]))
)


@given(st.lists(offers, min_size=1, max_size=QUEUE))
def test_frames_offered_at_once_go_by_identifier_and_order(offers: list[tuple[int, Frame]]) -> None:
    one = wire()
    for port, frame in offers:
        one.offer(0, port, frame)
    delivered = run(one)
    expected = sorted(offers, key=lambda o: o[1].id)  # a stable sort: ties keep the order of offering
    assert [(d.sender, d.frame) for d in delivered] == expected
    now = 0
    for d in delivered:
        assert d.time == now + duration(d.frame) and d.missed == 0
        now = d.time + 3 * BIT
    waits = one.waits()
    assert sum(w.frames for w in waits.values()) == len(offers)
    last_started = now - frame_ns(expected[-1][1], 1e6, 5e6)
    assert max(w.longest for w in waits.values()) == last_started
    assert all(w.shortest <= w.mean <= w.longest for w in waits.values())
    assert one.collisions == one.errors == 0 and one.error_frames() == []


addresses = st.one_of(
    st.tuples(st.integers(0, 2**29 - 1), st.just(True), st.booleans()),
    st.tuples(st.integers(0, 2**11 - 1), st.just(False), st.booleans()),
    st.sampled_from([(0x155, False, r) for r in (False, True)]),
    st.sampled_from([(0x155 << 18 | n, True, r) for r in (False, True) for n in (0, 5, 0x3FFFF)]),
)


@given(st.lists(addresses, min_size=1, max_size=5, unique=True))
def test_arbitration_compares_the_bits_as_they_are_sent(wanted: list[tuple[int, bool, bool]]) -> None:
    def sent_bits(frame: Frame) -> str:
        """Dominant 0 wins. RTR, IDE and r0 of base, SRR, IDE, RTR of extended frames."""
        if frame.extended:
            return f"{frame.id >> 18:011b}11{frame.id & 0x3FFFF:018b}{frame.remote:d}"
        return f"{frame.id:011b}{frame.remote:d}00"

    contenders = [Frame(i, b"", False, False, extended, remote) for i, extended, remote in wanted]
    one = wire()
    for port, frame in enumerate(contenders):
        one.offer(0, port, frame)
    assert [d.frame for d in run(one)] == sorted(contenders, key=sent_bits)
    assert one.errors == 0


def test_a_frame_under_way_is_not_interrupted_by_a_higher_priority() -> None:
    one = wire()
    one.offer(0, 0, Frame(0x700, bytes(64)))
    one.advance(0)
    one.offer(1, 1, Frame(0x001, b""))
    assert [d.frame.id for d in run(one)] == [0x700, 0x001]


def test_delay_jitter_and_loss_apply_to_deliveries_only() -> None:
    late, frame = wire(delay="1ms"), Frame(0x100, b"")
    late.offer(0, 0, frame)
    late.offer(0, 0, frame)
    first, second = run(late)
    assert first.time == 1_000_000 + duration(frame)
    assert second.time - first.time == frame_ns(frame, 1e6, 5e6)  # the bus went on meanwhile
    deaf = wire(loss=1.0)
    deaf.offer(0, 0, frame)
    assert run(deaf) == [] and (deaf.sent, deaf.lost, deaf.traffic()[0x100, False].lost) == (1, 1, 1)
    shaken = wire(jitter="5ms")
    for n in range(QUEUE):
        shaken.offer(0, 0, Frame(0x100 + n, b""))
    order = [d.frame.id for d in run(shaken)]
    assert sorted(order) == [0x100 + n for n in range(QUEUE)] and order != sorted(order)


@pytest.mark.parametrize("queue", ["priority", "fifo"])
def test_a_full_transmit_queue_refuses_and_empties_again(queue: str) -> None:
    one, frame = wire(queue=queue), Frame(0x181, b"")
    assert all(one.offer(0, 1, frame) for _ in range(QUEUE))
    assert not one.offer(0, 1, frame)
    assert one.refused == 1
    assert one.offer(0, 2, Frame(0x182, b""))  # another port's queue is its own
    assert len(run(one)) == QUEUE + 1
    assert one.offer(10**9, 1, frame)


def test_mailboxes_go_by_priority_and_a_fifo_inverts_it() -> None:
    """A node's urgent frame behind its lazy one: by mailboxes it goes first; in a FIFO it waits until the middling
    frames of another node are through, which the lazy one loses to."""
    lazy, middling, urgent = (Frame(i, b"\x55" * 8) for i in (0x600, 0x300, 0x100))
    order = {}
    for queue in ("priority", "fifo"):
        one = wire(queue=queue)
        one.offer(0, 0, lazy)
        one.offer(0, 0, urgent)
        for _ in range(3):
            one.offer(0, 1, middling)
        order[queue] = [d.frame.id for d in run(one)]
        assert one.waits()[0x100, False].longest == (0 if queue == "priority" else 4 * frame_ns(lazy, 1e6, 5e6))
    assert order["priority"] == [0x100, 0x300, 0x300, 0x300, 0x600]
    assert order["fifo"] == [0x300, 0x300, 0x300, 0x600, 0x100]


@given(st.lists(offers, min_size=1, max_size=QUEUE))
def test_a_fifo_keeps_the_order_of_each_port(offers: list[tuple[int, Frame]]) -> None:
    one = wire(queue="fifo")
    for port, frame in offers:
        one.offer(0, port, frame)
    left = {port: [frame for sender, frame in offers if sender == port] for port in range(5)}
    for d in run(one):
        heads = {port: frames[0] for port, frames in left.items() if frames}
        assert d.frame.id == min(frame.id for frame in heads.values()) and d.frame == left[d.sender].pop(0)
    assert not any(left.values())


def test_waiting_times_come_as_percentiles() -> None:
    one, frame = wire(), Frame(0x181, b"\x55" * 24)
    for _ in range(20):
        one.offer(0, 1, frame)
    run(one)
    traffic = one.traffic()[0x181, False]
    each = frame_ns(frame, 1e6, 5e6)
    assert (traffic.sent, traffic.lost, traffic.retransmitted) == (20, 0, 0)
    assert traffic.wait.percentile(5) == 0 and traffic.wait.percentile(100) == 19 * each == traffic.wait.longest
    for n in range(20):
        assert n * each <= traffic.wait.percentile(5 * (n + 1)) <= n * each * (1 + 1 / 16)


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
    assert one.next_ns == NEVER


@given(st.integers(0, 1000), st.integers(0, 60))
@settings(max_examples=40)
def test_a_restored_wire_continues_identically(seed: int, steps: int) -> None:
    def loaded(s: int) -> Wire:
        return wire(s, delay="50us", jitter="200us", loss=0.1, bit_error_rate=1e-3)

    one = loaded(seed)
    for n in range(40):
        one.offer(0, n % 5, Frame(0x100 + 7 * n % 40, bytes([n]) * 8))
    one.cut(4, True, 0)
    one.damage(0x107, 2, "data:3")
    for _ in range(steps):
        if one.next_ns == NEVER:
            break
        one.advance(one.next_ns)
    saved = pickle.loads(pickle.dumps(one.snapshot()))
    expected = run(one), one.snapshot()
    other = loaded(seed)
    other.offer(3, 1, Frame(1, b""))
    other.restore(saved)
    assert (run(other), other.snapshot()) == expected
