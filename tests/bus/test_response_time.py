"""Response-time analysis against published tables, and against the wire that it makes claims about."""

import heapq

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.config import BusConfig
from bus.frames import CAN_FD_LENGTHS, Frame
from bus.link import NEVER
from bus.response_time import (
    ERROR_FRAME_BITS,
    Message,
    longest_frame,
    longest_frame_bits,
    longest_frame_ns,
    response_times,
    utilisation,
)
from bus.timing import TAIL, BitRates, frame_bits, frame_ns
from bus.wire import Wire
from hil.streams import streams

US, MS = 1_000, 1_000_000
RATES = BitRates(1e6, 5e6)

# --- published tables -----------------------------------------------------------------------------------------


def test_the_example_that_refuted_the_older_analysis() -> None:
    """Davis et al. 2007, §3.1: three messages of 7 bytes at 125 kbit/s. The older analysis gives C 3 ms and calls it
    schedulable; its second instance takes 3.5 ms."""
    frame = 125 * 8 * US  # 55 + 10 · 7 bits
    periods = {"A": (2.5, 2.5), "B": (3.5, 3.25), "C": (3.5, 3.25)}
    messages = [
        Message(name, order, frame, round(t * MS), deadline=round(d * MS))
        for order, (name, (t, d)) in enumerate(periods.items())
    ]
    found = response_times(messages, bit_ns=8 * US)
    assert [(r.message.name, r.longest, r.schedulable) for r in found] == [
        ("A", 2 * MS, True), ("B", 3 * MS, True), ("C", round(3.5 * MS), False),
    ]  # fmt: skip
    assert found[2].instances == 2 and found[2].slack == -round(0.25 * MS)


# (data bytes, period and deadline in ms, published response time in ms): the SAE benchmark with its signals gathered
# into 17 messages, Tindell and Burns 1994, "Guaranteeing message latencies on Controller Area Network", 125 kbit/s.
SAE = [
    (1, 50, 5, 1.416), (2, 5, 5, 2.016), (1, 5, 5, 2.536), (2, 5, 5, 3.136), (1, 5, 5, 3.656), (2, 5, 5, 4.256),
    (6, 10, 10, 5.016), (1, 10, 10, 8.376), (2, 10, 10, 8.976), (2, 10, 10, 9.576), (1, 50, 20, 10.096),
    (4, 100, 100, 19.096), (1, 100, 100, 19.616), (1, 100, 100, 20.136), (3, 1000, 1000, 28.976),
    (1, 1000, 1000, 29.496), (1, 1000, 1000, 29.520),
]  # fmt: skip


def test_the_sae_benchmark() -> None:
    """They count the blocking frame without its intermission of three bits."""
    bit = 8 * US
    messages = [
        Message(str(n), n, (55 + 10 * size) * bit, t * MS, deadline=d * MS) for n, (size, t, d, _) in enumerate(SAE)
    ]
    for response, (_, _, _, published) in zip(response_times(messages, bit), SAE, strict=True):
        intermission = 3 * bit if response.blocking else 0
        assert response.longest is not None and response.longest - intermission == round(published * MS)
        assert response.schedulable


def test_more_than_the_bus_carries_has_no_bound() -> None:
    found = response_times([Message("a", 0, 60, 100), Message("b", 1, 60, 100)], 1)
    assert [r.longest for r in found] == [121 - 1, None]
    assert not found[1].schedulable and found[1].slack is None
    assert utilisation([r.message for r in found]) == pytest.approx(1.2)


def test_a_fault_costs_an_error_frame_and_the_longest_frame_that_may_be_hit() -> None:
    """By hand: one fault within the span of either message, none has a second."""
    high, low = Message("high", 0, 50 * US, MS), Message("low", 1, 130 * US, MS)
    error = ERROR_FRAME_BITS * US
    found = response_times([high, low], US, fault_interval=10 * MS)
    assert [r.longest for r in found] == [130 * US + error + 50 * US + 50 * US, 50 * US + error + 130 * US + 130 * US]
    often = response_times([high, low], US, fault_interval=300 * US)  # a second fault fits in
    assert often[1].longest == found[1].longest + error + 130 * US
    assert response_times([high, low], US, fault_interval=100 * US)[1].longest is None


def test_jitter_of_the_higher_lets_two_of_its_frames_in() -> None:
    low = Message("low", 1, 100, 1000)
    quiet, jittery = Message("high", 0, 100, 1000), Message("high", 0, 100, 1000, jitter=950)
    assert response_times([quiet, low], 1)[1].longest == 200
    found = response_times([jittery, low], 1)
    assert found[1].longest == 300
    assert (found[0].longest, found[0].from_queue) == (950 + 200, 250)  # its second comes 50 behind


# --- the longest frames ---------------------------------------------------------------------------------------


@given(
    st.booleans(), st.booleans(), st.booleans(), st.integers(0, 2**29 - 1), st.sampled_from(CAN_FD_LENGTHS),
    st.randoms(use_true_random=False), st.sampled_from([0.5, 0.9, 0.98]),
)  # fmt: skip
def test_no_content_makes_a_longer_frame(fd, brs, extended, identifier, length, random, keep) -> None:
    """Contents of long runs: each bit repeats the one before it with probability ``keep``."""
    length = length if fd else min(length, 8)
    brs, identifier = brs and fd, identifier if extended else identifier & 0x7FF
    bits, value = 1, 0
    for _ in range(8 * length):
        bits = bits if random.random() < keep else 1 - bits
        value = value << 1 | bits
    frame = Frame(identifier, value.to_bytes(length, "big"), fd, brs, extended)
    slow, fast = longest_frame_bits(identifier, length, fd, brs, extended)
    found = frame_bits(frame)
    assert found.slow + TAIL <= slow and found.fast <= fast
    assert frame_ns(frame, 1e6, 5e6) <= longest_frame_ns(identifier, length, RATES, fd, brs, extended)


def test_the_longest_two_byte_frame_is_the_longest_of_all_contents() -> None:
    for identifier in (0x000, 0x0F8, 0x181, 0x2AA, 0x7FF):
        every = [frame_bits(Frame(identifier, n.to_bytes(2, "big"))) for n in range(1 << 16)]
        slow, fast = longest_frame_bits(identifier, 2)
        assert (max(b.slow for b in every) + TAIL, max(b.fast for b in every)) == (slow, fast)


@pytest.mark.parametrize("length, limit", [(8, 56_600), (16, 72_600), (32, 105_600), (64, 169_600)])
def test_longest_can_fd_frames_meet_the_published_bound(length: int, limit: int) -> None:
    """Bordoloi and Samii 2014: 32 + 3 bits of arbitration and 28 + 5 ⌈(p − 16) / 64⌉ + 10 p of data, for all
    identifiers at once. They count the stuff bits of each part apart, a little more than there can be."""
    longest = max(longest_frame_ns(identifier, length, RATES) for identifier in range(2048))
    assert limit - 2200 <= longest <= limit


def test_longest_classical_frames_have_135_and_160_bits() -> None:
    assert longest_frame_bits(0x123, 8, fd=False, brs=False) == (135, 0)
    assert longest_frame_bits(0x123, 8, fd=False, brs=False, extended=True) == (160, 0)
    assert [longest_frame_bits(0x123, n, False, False)[0] for n in range(9)] == [55 + 10 * n for n in range(9)]


# --- against the wire -----------------------------------------------------------------------------------------


class Traffic:
    """Messages of CAN FD frames on a wire of their own; each message has a port, and there is one that only listens."""

    def __init__(self, frames: list[Frame], messages: list[Message]) -> None:
        self.frames, self.messages = frames, messages
        self.wire = Wire("leg", BusConfig(), len(frames) + 1, streams(1))

    def responses(self, releases: list[tuple[int, int, int]]) -> list[int]:
        """Longest time of each message from event to end of intermission, for (queued, event, message)."""
        wire, pending = self.wire, sorted(releases)
        events: list[list[int]] = [[] for _ in self.messages]
        longest = [0] * len(self.messages)
        at = 0
        while at < len(pending) or wire.next_ns < NEVER:
            queued = pending[at][0] if at < len(pending) else NEVER
            now = min(queued, wire.next_ns)
            while at < len(pending) and pending[at][0] == now:
                _, event, m = pending[at]
                assert wire.offer(now, m, self.frames[m])
                events[m].append(event)
                at += 1
            if wire.next_ns == now:
                for delivery in wire.advance(now):
                    m = delivery.sender
                    longest[m] = max(longest[m], delivery.time + 3 * US - events[m].pop(0))
        return longest


lengths = st.sampled_from([0, 1, 8, 24, 64])


@st.composite
def message_sets(draw: st.DrawFn) -> list[tuple[int, Message]]:
    """(length, message) of up to five messages that the bus can carry, the most urgent first."""
    count = draw(st.integers(2, 5))
    found = []
    for n in range(count):
        length, period = draw(lengths), draw(st.integers(200, 1500)) * US
        jitter = draw(st.sampled_from([0, 0, period // 7, period // 2]))
        frame = longest_frame_ns(0x100 + n, length, RATES)
        found.append((length, Message(str(n), n, frame, period, jitter, deadline=NEVER)))
    return found if utilisation([m for _, m in found]) < 0.95 else found[:1]


@settings(max_examples=60, deadline=None)
@given(message_sets(), st.randoms(use_true_random=False))
def test_no_response_on_the_wire_exceeds_its_bound(drawn: list[tuple[int, Message]], random) -> None:
    messages = [m for _, m in drawn]
    frames = [Frame(0x100 + n, random.randbytes(length)) for n, (length, _) in enumerate(drawn)]
    releases = []
    for n, m in enumerate(messages):
        event = random.randrange(m.period)
        while event < 12 * MS:
            releases.append((event + random.randint(0, m.jitter), event, n))
            event += m.period
    bounds = response_times(messages, 1)
    for seen, bound in zip(Traffic(frames, messages).responses(releases), bounds, strict=True):
        assert bound.longest is not None and seen <= bound.longest
    from_queue = [(queued, queued, n) for queued, _, n in releases]
    for seen, bound in zip(Traffic(frames, messages).responses(from_queue), bounds, strict=True):
        assert bound.from_queue is not None and seen <= bound.from_queue


@settings(max_examples=25, deadline=None)
@given(message_sets(), st.data())
def test_the_critical_instant_attains_the_bound(drawn: list[tuple[int, Message]], data: st.DataObject) -> None:
    """All are queued, as late as their jitter allows, one nanosecond after the longest lower frame has begun, and
    from then on as early as can be. That nanosecond is what the wire resolves, and all that is missing."""
    subject = data.draw(st.integers(0, len(drawn) - 1))
    lower = drawn[subject + 1 :]
    taking_part = drawn[: subject + 1]
    if lower:
        taking_part = [*taking_part, max(lower, key=lambda item: item[1].frame)]
    messages = [m for _, m in taking_part]
    frames = [longest_frame(0x100 + m.order, length) for length, m in taking_part]
    assert [frame_ns(f, 1e6, 5e6) for f in frames] == [m.frame for m in messages]
    if lower:  # begun a nanosecond before: so much less of it is left
        blocker = messages[-1]
        messages[-1] = Message("blocker", blocker.order, blocker.frame - 1, 10**12)
    bound = response_times(messages, 1)[subject]
    assert bound.longest is not None
    releases = [(0, 0, len(messages) - 1)] if lower else []
    for n, m in enumerate(messages[: subject + 1]):
        for k in range(60):  # beyond the end of any of these busy periods
            event = 1 - m.jitter + k * m.period
            releases.append((max(event, 1), event, n))
    assert Traffic(frames, messages).responses(releases)[subject] == bound.longest


# --- with faults ----------------------------------------------------------------------------------------------


def with_faults(messages: list[Message], releases: list[tuple[int, int, int]], faults: list[int]) -> list[int]:
    """Longest times from event to end of frame on a bus where ``faults`` strike: a frame under way at such a time is
    broken off, an error frame follows, and it goes back into arbitration. Every frame is as long as it can be."""
    pending, waiting, longest = sorted(releases), [], [0] * len(messages)
    now, at, next_fault = 0, 0, 0
    while at < len(pending) or waiting:
        if not waiting:
            now = max(now, pending[at][0])
        while at < len(pending) and pending[at][0] <= now:
            heapq.heappush(waiting, (pending[at][2], pending[at][1]))
            at += 1
        m, event = heapq.heappop(waiting)
        while next_fault < len(faults) and faults[next_fault] < now:
            next_fault += 1
        if next_fault < len(faults) and faults[next_fault] < now + messages[m].frame:
            now = faults[next_fault] + ERROR_FRAME_BITS * US
            next_fault += 1
            heapq.heappush(waiting, (m, event))
        else:
            now += messages[m].frame
            longest[m] = max(longest[m], now - event)
    return longest


@settings(max_examples=100)
@given(message_sets(), st.integers(1, 4), st.randoms(use_true_random=False))
def test_no_response_exceeds_its_bound_when_faults_keep_their_distance(drawn, spacing: int, random) -> None:
    messages = [m for _, m in drawn]
    interval = spacing * 1500 * US
    bounds = response_times(messages, US, interval)
    releases = []
    for n, m in enumerate(messages):
        event = random.randrange(m.period)
        while event < 12 * MS:
            releases.append((event + random.randint(0, m.jitter), event, n))
            event += m.period
    faults, time = [], random.randrange(interval)
    while time < 20 * MS:
        faults.append(time)
        time += interval + random.choice([0, 0, random.randrange(interval)])
    for seen, bound in zip(with_faults(messages, releases, faults), bounds, strict=True):
        assert bound.longest is None or seen <= bound.longest
