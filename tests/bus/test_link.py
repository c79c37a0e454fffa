"""The link in virtual time: order of arrival, loss, restoring."""

from hypothesis import given
from hypothesis import strategies as st

from bus.config import Impairment
from bus.link import NEVER, Link
from hil.streams import streams


def link(seed: int = 1, **values: object) -> Link:
    return Link("link.state", Impairment.model_validate(values), streams(seed))


def test_a_perfect_link_delivers_at_once_and_in_order() -> None:
    perfect = link()
    assert perfect.next_ns == NEVER
    for n in range(5):
        perfect.send(10, n, 100)
    assert perfect.next_ns == 10
    assert perfect.pop_due(9) == []
    assert perfect.pop_due(10) == [(10, n) for n in range(5)]
    assert perfect.next_ns == NEVER


@given(st.lists(st.integers(0, 3_000_000), min_size=1, max_size=40).map(sorted), st.integers(0, 100))
def test_arrivals_are_ordered_and_within_delay_and_jitter(sent_at: list[int], seed: int) -> None:
    late = link(seed, delay="1ms", jitter="2ms")
    arrived: list[tuple[int, int]] = []
    for n, now in enumerate(sent_at):
        arrived += late.pop_due(now)
        late.send(now, n, 8)
    while late.next_ns != NEVER:
        now = late.next_ns
        due = late.pop_due(now)
        assert due and all(arrival == now for arrival, _ in due)
        arrived += due
    assert [a for a, _ in arrived] == sorted(a for a, _ in arrived)
    assert sorted(n for _, n in arrived) == list(range(len(sent_at)))
    for arrival, n in arrived:
        assert 1_000_000 <= arrival - sent_at[n] < 3_000_000


def test_lost_and_damaged_samples_vanish_and_are_counted() -> None:
    assert_all_lost = link(loss=1.0), link(bit_error_rate=1.0)
    for broken in assert_all_lost:
        broken.send(0, b"x", 8)
        assert (broken.sent, broken.lost, broken.next_ns) == (1, 1, NEVER)
    mended = assert_all_lost[0]
    mended.set("loss", 0.0)
    mended.send(1, b"y", 8)
    assert mended.pop_due(1) == [(1, b"y")]


def test_a_restored_link_continues_identically() -> None:
    def carry_on(one: Link) -> list[tuple[int, int]]:
        for n in range(30):
            one.send(n * 100_000, n, 500)
        return one.pop_due(NEVER)

    original = link(jitter="5ms", loss=0.2, bit_error_rate=1e-4)
    for n in range(10):
        original.send(n, -n, 500)
    saved = original.snapshot()
    expected = carry_on(original), original.sent, original.lost
    other = link(seed=1)
    other.restore(saved)
    assert (carry_on(other), other.sent, other.lost) == expected
    other.restore(saved)  # the first continuation left the snapshot alone
    assert carry_on(other) == expected[0]
