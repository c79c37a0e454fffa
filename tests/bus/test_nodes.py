"""Attempts decided from the frame's length against the same attempts played bit by bit; misread bits."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.bitstream import DOMINANT, ViolationError, encode
from bus.confinement import Counters
from bus.frames import Frame
from bus.nodes import Nodes, misread
from bus.receiver import decode
from bus.timing import BitRates, contender
from tests.bus.frame_strategy import frames

counters = st.builds(Counters, st.integers(0, 255), st.one_of(st.integers(0, 3), st.integers(90, 160)))


@given(st.lists(frames(), min_size=1, max_size=4, unique_by=lambda f: contender(f)[0]),
       st.lists(counters, min_size=5, max_size=5), st.booleans(),
       st.sampled_from([(1e6, 5e6), (5e5, 2e6), (8e5, 3e6)]))  # fmt: skip
@settings(max_examples=80)
def test_the_short_way_and_the_bits_come_to_the_same(
    wanted: list[Frame], states: list[Counters], listening: bool, rates: tuple[float, float]
) -> None:
    """Arbitration, times, who receives, counters and what is told of them, among nodes with any past."""
    nodes = Nodes(len(states), BitRates(*rates), True)
    nodes.counters = states
    if listening:
        nodes.listen_only.add(4)
    heads = {port: nodes.as_sent(port, frame) for port, frame in enumerate(wanted)}
    winner = min(heads, key=lambda port: contender(heads[port])[0])
    hearing = list(range(len(states)))
    now = 12_345
    short = nodes._success(now, winner, heads[winner], hearing)
    played = nodes._played(now, heads, hearing, {})
    assert set(played.ready_at.values()) == {short.idle}
    played.ready_at = {}
    # receivers count at the ACK slot, the short way tells of it at the end of the frame
    assert sorted((p, e) for _, p, e in played.events) == sorted((p, e) for _, p, e in short.events)
    played.events = short.events
    assert played == short


@given(frames(), st.integers(1, 199))
def test_a_small_error_of_the_bit_rate_does_not_matter(frame: Frame, thousandths: int) -> None:
    levels = bytearray(encode(frame).levels)
    levels[encode(frame).ack] = DOMINANT
    for ratio in (1 + thousandths / 1e4, 1 - thousandths / 1e4):
        assert misread(levels, ratio) == frozenset()


def test_a_large_error_of_the_bit_rate_breaks_frames() -> None:
    """5 %: the phase error exceeds 20 % of a bit after four bits without an edge to recessive and back."""
    for frame in (Frame(0x181, bytes(range(24))), Frame(0x7F0, b"\x0f" * 8, fd=False, brs=False)):
        levels = bytearray(encode(frame).levels)
        levels[encode(frame).ack] = DOMINANT
        for ratio in (1.05, 0.95):
            wrong = misread(levels, ratio)
            assert wrong
            for n in wrong:
                levels[n] ^= 1
            with pytest.raises(ViolationError):
                decode(bytes(levels))
            for n in wrong:
                levels[n] ^= 1


def test_a_node_that_reads_the_bits_of_a_nominal_sender_by_sampling() -> None:
    """Against a receiver that samples a waveform at 80 % of its own bits and starts its bit anew at each falling edge:
    a slow one takes the bit after a late sample for the one before."""
    levels = bytearray([1, *([0] * 5 + [1] * 5) * 3, 0])
    for percent in range(1, 12):
        ratio = 1 + percent / 100
        seen = list(levels)
        edge = 1
        for n in range(2, len(levels) + 1):
            if n == len(levels) or (levels[n - 1] == 1 and levels[n] == 0):
                for k in range(n - edge):
                    seen[edge + k] = levels[min(int(edge + (k + 0.8) * ratio), len(levels) - 1)]
                edge = n
        expected = {n for n in range(len(levels)) if seen[n] != levels[n] and n % 10 == 0}
        found = misread(levels, ratio)
        assert found == expected or (percent == 2 and found | expected <= {10, 20, 30})
