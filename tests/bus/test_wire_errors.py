"""Errors on the wire against what ISO 11898-1 says comes of them: flags, counters, retransmission, bus off."""

import pickle
from itertools import pairwise
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.bitstream import encode
from bus.config import BusConfig
from bus.confinement import Counters, State
from bus.frames import Frame
from bus.link import NEVER
from bus.timing import INTERMISSION, TAIL, frame_bits, frame_ns
from bus.wire import Wire
from hil.streams import streams

BIT = 1000  # ns, arbitration


class Delivery(NamedTuple):
    """``bus.wire.Delivery`` with its mask as a field, so that it is compared."""

    time: int
    sender: int
    frame: Frame
    missed: int = 0


DELIMITER = 8
CRTL, PROT, ACK, BUSOFF, RESTARTED = 0x4, 0x8, 0x20, 0x40, 0x100  # error classes of linux/can/error.h


def wire(seed: int = 1, ports: int = 5, **values: object) -> Wire:
    return Wire("leg", BusConfig.model_validate(values), ports, streams(seed))


def run(one: Wire, until: int = NEVER - 1, events: int = 100_000) -> list[Delivery]:
    delivered: list[Delivery] = []
    while one.next_ns <= until and events:
        now = one.next_ns
        delivered += [Delivery(*d) for d in one.advance(now)]
        assert one.next_ns >= now
        events -= 1
    assert events, "the wire does not come to rest"
    return delivered


def duration(frame: Frame) -> int:
    """Start of frame to end of EOF."""
    return frame_ns(frame, 1e6, 5e6) - INTERMISSION * BIT


def classical(identifier: int, data: bytes = b"\x55" * 8) -> Frame:
    return Frame(identifier, data, fd=False, brs=False)


def counts(one: Wire) -> list[tuple[int, int]]:
    return [one.ports_state(port)[:2] for port in range(one.ports)]


def wear(one: Wire, port: int, tec: int, rec: int = 0) -> None:
    """Give a node a past."""
    one._nodes.counters[port] = Counters(tec, rec)
    one._nodes.changed()


# --- damaged bits -------------------------------------------------------------------------------------------


def test_a_frame_without_its_sof_is_followed_by_two_flags_and_sent_again() -> None:
    """The sender misses its SOF and sends its flag. That is the SOF of the others: after six dominant bits they find
    a stuff error and add theirs."""
    one, frame = wire(), Frame(0x181, bytes(24))
    one.damage(0x181, 1, "sof")
    one.offer(0, 1, frame)
    one.offer(0, 1, frame._replace(data=b"\x01" * 24))  # of the same identifier: must not overtake
    restart = BIT + (6 + 6 + DELIMITER + INTERMISSION) * BIT
    assert run(one, restart - 1) == [] and one.errors == 1
    assert counts(one) == [(0, 1), (8, 0), (0, 1), (0, 1), (0, 1)]
    told = one.error_frames()
    assert [(at, port, e.data[2:4]) for at, port, e in told] == [
        (BIT, 1, b"\x88\x03"), *[(7 * BIT, port, b"\x04\x02") for port in (0, 2, 3, 4)]
    ]  # fmt: skip
    assert one.error_frames() == []
    assert one.next_ns == restart
    delivered = run(one)
    assert delivered[0] == Delivery(restart + duration(frame), 1, frame)
    assert delivered[1].frame.data == b"\x01" * 24
    traffic = one.traffic()[0x181, False]
    assert (traffic.sent, traffic.retransmitted) == (2, 1) and traffic.wait.shortest == restart
    assert one.busy_ns == restart + sum(frame_ns(d.frame, 1e6, 5e6) for d in delivered)
    assert counts(one) == [(0, 0), (6, 0), (0, 0), (0, 0), (0, 0)]


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_bit_errors_delay_frames_but_lose_none(seed: int) -> None:
    noisy = wire(seed, bit_error_rate=1e-3)
    sent = [Frame(0x180 + n, bytes([n]) * 24) for n in range(20)]
    for frame in sent:
        noisy.offer(0, 1, frame)
    delivered = run(noisy)
    clean = sum(frame_ns(frame, 1e6, 5e6) for frame in sent)
    longest = max(map(duration, sent))
    # at least a bit, flag, delimiter, intermission; at most the whole frame, two flags, an overload frame in passing
    least, most = BIT + 17 * BIT, longest + (12 + 2 * (DELIMITER + 6) + INTERMISSION) * BIT
    frames = [d.frame._replace(esi=False) for d in delivered]
    again = len(frames) - len(set(frames))  # an error in the last bit of EOF: received, and sent again
    assert sorted(set(frames)) == sent and noisy.sent == 20
    if all(state.state is not State.BUS_OFF for state in map(noisy.ports_state, range(5))) and not again:
        assert noisy.errors * least <= noisy.busy_ns - clean <= noisy.errors * most


def test_an_error_that_one_receiver_sees_is_everybodys_error() -> None:
    """It finds a wrong CRC and sends its flag after the ACK delimiter; who follows a flag is not to blame, who was
    first pays nine."""
    one, frame = wire(), classical(0x123)
    one.damage(0x123, 1, "crc:3", port=3)
    one.offer(0, 1, frame)
    until_delimiter = encode(frame).ack + 2
    # the flag begins with EOF: there the others find a form error, theirs begins one bit later
    ends = (until_delimiter + 7 + DELIMITER + INTERMISSION) * BIT
    assert run(one, ends - 1) == []
    assert counts(one) == [(0, 1), (8, 0), (0, 1), (0, 9), (0, 1)]
    assert [port for _, port, e in one.error_frames()] == [3, 0, 1, 2, 4]
    assert run(one) == [Delivery(ends + duration(frame), 1, frame)]


def test_an_error_in_the_last_but_one_bit_of_eof_makes_a_duplicate() -> None:
    """Rufino et al. 1998: a receiver that sees it rejects the frame, the others have it already, and the sender sends
    it again."""
    one, frame = wire(), classical(0x123)
    one.damage(0x123, 1, "eof:5", port=3)
    one.offer(0, 1, frame)
    first, second = run(one)
    assert first == Delivery(duration(frame), 1, frame, missed=1 << 3)
    assert second.frame == frame and second.missed == 0
    assert (one.sent, one.errors, one.traffic()[0x123, False].retransmitted) == (1, 1, 1)


def test_an_error_in_the_last_bit_of_eof_costs_an_overload_frame_only() -> None:
    one, frame = wire(), classical(0x123)
    one.damage(0x123, 1, "eof:6", port=3)
    one.offer(0, 1, frame)
    one.offer(0, 1, classical(0x124))
    first, second = run(one)
    assert first == Delivery(duration(frame), 1, frame) and one.errors == 0
    # its flag meets the intermission of the others, whose flags begin one bit later
    assert second.time == first.time + (1 + 6 + DELIMITER + INTERMISSION) * BIT + duration(second.frame)
    assert counts(one) == [(0, 0)] * 5


@given(st.integers(0, 24 * 8 - 8), st.binary(min_size=24, max_size=24))  # the fixed stuff bits are far
def test_an_error_in_the_data_phase_is_flagged_at_the_arbitration_rate(bit: int, data: bytes) -> None:
    """The sender's flag begins after the wrong bit. The others read it at the data rate and find a stuff error within
    six of its short bits; their flags outlast its own by up to 1.2 bits, so that the bus is free one bit later
    when that is more than one."""
    one, frame = wire(), Frame(0x123, data)
    one.damage(0x123, 1, f"data:{bit}")
    one.offer(0, 1, frame)
    bits = encode(frame)
    wrong = bits.place(f"data:{bit}")
    assert wrong is not None
    found = bits.fast.start * BIT + (wrong + 1 - bits.fast.start) * 200
    seen = [*bits.levels[:wrong], 1 - bits.levels[wrong]]
    run_of_zeros = next((n for n, level in enumerate(reversed(seen)) if level), len(seen))
    if len(set(seen[-6:])) == 1:  # the wrong bit itself is their stuff error: the flags coincide
        late = 0
    else:
        late = (6 - run_of_zeros) * 200
    restart = found + (6 + DELIMITER + INTERMISSION) * BIT + (BIT if late >= BIT else 0)
    (delivery,) = run(one)
    assert delivery.time == restart + duration(frame)
    first, *others = [(at, port) for at, port, e in one.error_frames() if e.classes & PROT]
    assert sorted([first, *others])[0][0] == found
    assert {at for at, port in [first, *others] if port != 1} == {found + late}


def test_damage_strikes_the_occurrence_it_names() -> None:
    one = wire()
    one.damage(0x123, 2, "data:5")
    for n in range(3):
        one.offer(0, 1, classical(0x123, bytes([n])))
        one.offer(0, 2, classical(0x124, bytes([n])))
    delivered = run(one)
    assert [d.frame.data[0] for d in delivered if d.frame.id == 0x123] == [0, 1, 2]
    assert one.errors == 1 and one.traffic()[0x123, False].retransmitted == 1
    assert one.traffic()[0x124, False].retransmitted == 0
    assert one.waits()[0x123, False].longest > 2 * frame_ns(delivered[0].frame, 1e6, 5e6)


def test_wrong_places_of_damage_are_refused_in_words() -> None:
    one = wire()
    for occurrence, bit, port, words in [
        (0, 3, None, "occurrence 0: expected 1 or more"), (1, -1, None, "bit -1: expected 0 or more"),
        (1, "dta:3", None, "no bit 'dta:3'.*data"), (1, "data:x", None, "no bit"),
        (1, 3, 9, "bus leg has no port 9: expected 0 to 4"),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match=words):
            one.damage(0x123, occurrence, bit, port=port)
    with pytest.raises(ValueError, match=r"0\.5 to 2"):
        one.bit_rate_error(1, float("nan"), 0)


# --- acknowledgement ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("alone", ["only", "cut", "listening"])
def test_a_lonely_node_becomes_error_passive_and_no_more(alone: str) -> None:
    one, frame = wire(ports=1 if alone == "only" else 3), classical(0x123)
    for port in range(1, one.ports):
        (one.cut if alone == "cut" else one.listen_only)(port, True, 0)
    one.offer(0, 0, frame)
    until_ack = encode(frame).ack + 1
    active, passive = until_ack + 6 + DELIMITER + INTERMISSION, until_ack + 6 + DELIMITER + INTERMISSION + 8
    after = (16 * active + 8) * BIT  # the sixteenth made it passive: it suspends
    assert run(one, after - 1) == []
    told = one.error_frames()
    assert [e.data[6] for _, _, e in told if e.classes & ACK] == list(range(8, 129, 8))
    assert [at for at, _, e in told if e.classes & ACK] == [(n * active + until_ack) * BIT for n in range(16)]
    assert [e.data[1] for _, _, e in told if e.classes & CRTL] == [0x08, 0x20]  # warning, passive
    run(one, after + 20 * passive * BIT)
    told = one.error_frames()
    assert {e.data[6] for _, _, e in told} == {128}
    assert [at for at, _, _ in told] == [after + (n * passive + until_ack) * BIT for n in range(20)]
    if one.ports > 1:  # somebody comes to help
        now = one.next_ns
        (one.cut if alone == "cut" else one.listen_only)(2, False, now)
        *repeated, delivery = run(one)
        assert delivery.frame == frame and one.ports_state(0).tec == 127
        assert delivery.missed == (1 << 1 if alone == "cut" else 0)
        # a passive flag disturbs nobody: who only listens has heard the frame every time
        assert len(repeated) == (1 if alone == "listening" else 0)


# --- collisions ---------------------------------------------------------------------------------------------


def test_the_same_frame_of_two_nodes_is_one_frame() -> None:
    one, frame = wire(), Frame(0x10, b"\x03" * 8)
    one.offer(0, 3, frame)
    one.offer(0, 2, frame)
    assert run(one) == [Delivery(duration(frame), 2, frame)]
    assert (one.sent, one.collisions, one.errors) == (2, 1, 0) and counts(one) == [(0, 0)] * 5


def test_without_a_third_node_nobody_acknowledges_it() -> None:
    one, frame = wire(ports=2), classical(0x10)
    one.offer(0, 0, frame)
    one.offer(0, 1, frame)
    run(one, 10 * BIT * 200)
    assert one.sent == 0 and one.ports_state(0) == one.ports_state(1) and one.ports_state(0).tec > 0


def test_one_identifier_of_two_nodes_collides_until_they_are_error_passive() -> None:
    """Both active flags destroy both frames, sixteen times. Then the one that sends the recessive bit can only object
    passively: the other gets through, and it itself right after."""
    one = wire()
    weak, strong = classical(0x10, b"\xf0"), classical(0x10, b"\x70")
    one.offer(0, 3, weak)
    one.offer(0, 2, strong)
    delivered = run(one)
    assert [(d.sender, d.frame) for d in delivered] == [(2, strong), (3, weak)]
    assert one.errors >= 16 and one.traffic()[0x10, False].retransmitted >= 32
    told = one.error_frames()
    at = encode(weak).place("data:0")
    assert at is not None
    first = [(time, port, e.data[2], e.data[3]) for time, port, e in told][:2]
    assert first[0] == ((at + 1) * BIT, 3, 0x90, 0x0A)  # sent recessive, in the data
    passive = [port for _, port, e in told if e.classes & CRTL and e.data[1] == 0x20]
    assert passive == [3, 2]  # in the order in which they see it
    assert one.collisions == 17


def test_can_fd_and_classical_frames_of_one_identifier_collide_at_fdf() -> None:
    one = wire()
    one.offer(0, 1, Frame(0x2AA, b"\x55"))
    one.offer(0, 2, classical(0x2AA, b"\x55"))
    run(one, 15 * BIT)
    ((time, port, error), *_) = one.error_frames()
    assert (time, port, error.data[2], error.data[3]) == (15 * BIT, 1, 0x90, 0x0D)  # SOF 11 RTR IDE FDF


def test_data_beats_remote_and_base_beats_extended_without_an_error() -> None:
    one = wire()
    frames = [
        Frame(0x155 << 18, b"", False, False, extended=True), Frame(0x155, bytes(2), False, False, remote=True),
        Frame(0x155, b"\x01", False, False), Frame(0x155 << 18, b"", False, False, extended=True, remote=True),
    ]  # fmt: skip
    for port, frame in enumerate(frames):
        one.offer(0, port, frame)
    assert [d.sender for d in run(one)] == [2, 1, 0, 3]
    assert one.errors == 0 and counts(one) == [(0, 0)] * 5


# --- error passive and bus off ------------------------------------------------------------------------------


def test_an_error_passive_sender_tells_it_and_lets_others_go_first() -> None:
    one, frame = wire(), Frame(0x100, b"\x55" * 8)
    wear(one, 1, 140)
    one.offer(0, 1, frame)
    one.offer(0, 1, frame)
    one.offer(0, 2, Frame(0x700, b""))
    delivered = run(one)
    assert [(d.frame.id, d.frame.esi) for d in delivered] == [(0x100, True), (0x700, False), (0x100, True)]
    alone = wire()
    wear(alone, 1, 140)
    for _ in range(3):
        alone.offer(0, 1, frame)
    times = [d.time for d in run(alone)]
    each = frame_ns(frame._replace(esi=True), 1e6, 5e6)
    assert [b - a for a, b in pairwise(times)] == [each + 8 * BIT] * 2
    assert alone.ports_state(1).tec == 137


def test_a_passive_receivers_objection_does_not_disturb() -> None:
    one, frame = wire(), classical(0x123)
    wear(one, 3, 0, 150)
    one.damage(0x123, 1, "data:9", port=3)
    one.offer(0, 1, frame)
    one.offer(0, 1, classical(0x124))
    first, second = run(one)
    assert first == Delivery(duration(frame), 1, frame, missed=1 << 3)
    assert one.ports_state(3).rec in range(119, 152) and one.ports_state(1).tec == 0
    # its delimiter is not over when the next frame starts
    assert second.missed == 1 << 3


def test_bus_off_after_32_errors_and_back_after_128_times_11_recessive_bits() -> None:
    one, frame = wire(bit_error_rate=1.0), classical(0x123)
    one.offer(0, 1, frame)
    told = []
    while one.ports_state(1).state is not State.BUS_OFF:
        one.advance(one.next_ns)
        told += one.error_frames()
    one.set("bit_error_rate", 0.0)
    assert one.errors == 32
    mine = [e for _, port, e in told if port == 1]
    assert sum(bool(e.classes & PROT) for e in mine) == 32
    assert [e.data[1] for e in mine if e.classes & CRTL] == [0x08, 0x20]
    one.offer(one._free_at, 2, classical(0x222))  # the others go on, and each frame ends in 11 recessive bits
    other = run(one, one._free_at + 200 * BIT)
    assert [d.missed for d in other] == [1 << 1]
    (bus_off,) = [at for at, port, e in told + one.error_frames() if e.classes & BUSOFF]
    idle = one._free_at
    (delivery,) = run(one)
    assert delivery.frame == frame
    (back,) = [at for at, _, e in one.error_frames() if e.classes & RESTARTED]
    assert back == idle + (128 - 2) * 11 * BIT  # one sequence after the last error frame, one with the frame
    assert delivery.time == back + duration(frame)
    assert bus_off < other[0].time and one.ports_state(1) == (0, 0, State.ERROR_ACTIVE)


def test_on_request_a_node_stays_bus_off_until_it_is_restarted() -> None:
    one, frame = wire(bus_off_recovery="request"), classical(0x123)
    wear(one, 1, 248)
    one.damage(0x123, 1, "data:3")
    one.offer(0, 1, frame)
    assert run(one) == [] and one.ports_state(1).state is State.BUS_OFF
    assert one.next_ns == NEVER
    now = 10**9
    one.restart(2, now)  # is not bus off: nothing happens
    one.restart(1, now)
    (delivery,) = run(one)
    # since when the wire is recessive does not count, only how its sequences of eleven bits lie
    assert 0 <= now + 128 * 11 * BIT - (delivery.time - duration(frame)) < 11 * BIT


def test_a_noisy_bus_tells_its_load_of_errors_in_bounded_memory() -> None:
    one = wire(ports=2, bit_error_rate=0.05)
    for n in range(32):
        one.offer(0, 0, Frame(0x100 + n, bytes(64)))
    run(one, 300_000_000)
    assert len(one.error_frames()) <= 1024


# --- modes and faults of nodes ------------------------------------------------------------------------------


def test_one_shot_gives_up_what_fails_and_what_loses() -> None:
    one = wire()
    one.one_shot(1, True, 0)
    one.damage(0x100, 1, "data:3")
    for identifier in (0x100, 0x101):
        one.offer(0, 1, classical(identifier))
    one.offer(0, 2, classical(0x050))  # 0x100 loses to it
    assert [d.frame.id for d in run(one)] == [0x050, 0x101]
    assert one.dropped == 1 and one.traffic()[0x100, False].lost == 1
    one.damage(0x101, 1, "data:3")
    one.offer(10**9, 1, classical(0x101))
    assert run(one) == [] and (one.dropped, one.errors, one.waiting(1)) == (2, 1, 0)


def test_a_listener_receives_and_is_never_heard() -> None:
    one, frame = wire(), classical(0x123)
    one.listen_only(3, True, 0)
    one.damage(0x123, 1, "data:3", port=3)  # it alone sees it: nobody learns of it
    one.offer(0, 1, frame)
    one.offer(0, 3, classical(0x001))
    assert run(one) == [Delivery(duration(frame), 1, frame, missed=1 << 3)]
    assert counts(one) == [(0, 0)] * 5 and one.waiting(3) == 1
    one.listen_only(3, False, 10**9)
    assert [d.frame.id for d in run(one)] == [0x001]


def test_a_cut_node_neither_sends_receives_nor_acknowledges() -> None:
    one, frame = wire(ports=3), classical(0x123)
    one.cut(1, True, 0)
    one.offer(0, 1, classical(0x001))
    one.offer(0, 0, frame)
    assert run(one) == [Delivery(duration(frame), 0, frame, missed=1 << 1)]
    one.cut(1, False, 10**9)
    assert one.next_ns == 10**9
    (delivery,) = run(one)
    assert delivery == Delivery(10**9 + duration(classical(0x001)), 1, classical(0x001))


def test_who_misses_a_frame_is_told_also_when_it_comes_late_and_after_restoring() -> None:
    one, frame = wire(delay="1ms"), classical(0x123)
    one.cut(3, True, 0)
    one.offer(0, 1, frame)
    assert run(one, duration(frame)) == []
    other = wire(delay="1ms")
    other.restore(pickle.loads(pickle.dumps(one.snapshot())))
    assert run(one) == run(other) == [Delivery(1_000_000 + duration(frame), 1, frame, missed=1 << 3)]


def test_a_wire_stuck_in_a_frame_drives_its_sender_off_the_bus_and_the_others_passive() -> None:
    one, frame = wire(), classical(0x123)
    one.offer(0, 1, frame)
    one.advance(0)
    at = 40 * BIT
    one.stuck_dominant(4, True, at)
    assert run(one) == [] and one.next_ns == NEVER
    assert one.ports_state(1).state is State.BUS_OFF
    assert {one.ports_state(port).state for port in (0, 2, 3, 4)} == {State.ERROR_PASSIVE}
    told = one.error_frames()
    (off,) = [time for time, _, e in told if e.classes & BUSOFF]
    # a bit error within five bits, then the flag; from there 8 for each 8 dominant bits, until 256
    first = next(time for time, port, _ in told if port == 1)
    assert at < first <= at + 5 * BIT and off == first + (6 + 31 * 8) * BIT
    one.offer(10**9, 2, classical(0x050))
    assert one.next_ns == NEVER  # nothing passes
    let_go = 2 * 10**9
    one.stuck_dominant(4, False, let_go)
    busy = one.busy_ns
    assert abs(busy - let_go) <= 400 * BIT  # the wire was taken all the time
    first, second = run(one)
    assert first.frame.id == 0x050 and first.time == let_go + 11 * BIT + duration(classical(0x050))
    assert second.frame == frame and second.time >= let_go + 128 * 11 * BIT


def test_a_wire_stuck_while_idle_stops_everything_and_nobody_goes_off() -> None:
    one = wire()
    one.stuck_dominant(4, True, 5_000)
    one.offer(6_000, 1, classical(0x123))
    assert run(one) == []
    assert {one.ports_state(port).state for port in range(5)} == {State.ERROR_PASSIVE}
    one.stuck_dominant(4, False, 10**9)
    (delivery,) = run(one)
    assert delivery.time == 10**9 + 11 * BIT + duration(classical(0x123))


def test_cutting_the_stuck_node_frees_the_wire_even_at_once() -> None:
    one = wire()
    one.offer(0, 1, classical(0x123))
    one.advance(0)
    one.stuck_dominant(4, True, 40 * BIT)
    one.cut(4, True, 50 * BIT)
    assert one.busy_ns == 50 * BIT
    (delivery,) = run(one)
    assert delivery.frame.id == 0x123 and delivery.missed == 1 << 4
    assert all(at < 10**9 for at, _, _ in one.error_frames())
    one.stuck_dominant(3, True, 10**9)
    one.stuck_dominant(3, False, 10**9)  # nothing of it is left
    one.offer(10**9, 1, classical(0x124))
    assert [d.time for d in run(one)] == [10**9 + duration(classical(0x124))]


@pytest.mark.parametrize("factor", [0.985, 1.015])
def test_a_bit_rate_within_the_tolerance_does_no_harm(factor: float) -> None:
    one = wire()
    one.bit_rate_error(3, factor, 0)
    for n in range(20):
        one.offer(0, n % 4, Frame(0x100 + 4 * n + n % 4, bytes([n] * 24)))
    assert len(run(one)) == 20 and one.errors == 0


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_node_with_a_wrong_bit_rate_disturbs_until_it_is_passive(factor: float) -> None:
    one = wire()
    one.bit_rate_error(3, factor, 0)
    for n in range(30):
        one.offer(0, 1, classical(0x100 + n, bytes([n] * 8)))
    delivered = run(one)
    assert {d.frame.id for d in delivered} == {0x100 + n for n in range(30)}
    assert one.errors > 10
    assert all(d.missed & 1 << 3 for d in delivered)
    state = one.ports_state(3)
    assert state.state is State.ERROR_PASSIVE and state.rec >= 128
    one.offer(10**9, 3, classical(0x0AA, bytes(8)))  # and what it sends is an error of all others
    before = one.errors
    assert run(one, 10**9 + 20_000_000) == []
    assert one.errors > before + 16 and one.waiting(3) == 1


# --- state --------------------------------------------------------------------------------------------------


@given(st.integers(0, 1000), st.integers(0, 80), st.sampled_from(["priority", "fifo"]))
@settings(max_examples=15)
def test_a_restored_wire_continues_identically_amid_errors(seed: int, steps: int, queue: str) -> None:
    def loaded(s: int) -> Wire:
        return wire(s, delay="50us", jitter="200us", loss=0.1, bit_error_rate=3e-3, queue=queue)

    one = loaded(seed)
    one.one_shot(0, True, 0)
    one.bit_rate_error(2, 1.04, 0)
    one.damage(0x111, 2, "eof:5", port=3)
    for n in range(40):
        one.offer(0, n % 5, Frame(0x100 + 7 * n % 40, bytes([n]) * 8))  # ports share identifiers
    for _ in range(steps):
        if one.next_ns == NEVER:
            break
        one.advance(one.next_ns)
    saved = pickle.loads(pickle.dumps(one.snapshot()))
    end = 8_000_000
    expected = run(one, end), one.snapshot()
    other = loaded(seed)
    other.offer(3, 1, Frame(1, b""))
    other.cut(1, True, 3)
    other.restore(saved)
    assert (run(other, end), other.snapshot()) == expected


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 30), st.sampled_from([b"", b"\x00" * 8, b"\xff" * 8])),
                min_size=1, max_size=12), st.integers(0, 99))  # fmt: skip
@settings(max_examples=30)
def test_any_collisions_end_and_every_frame_gets_through(offers: list[tuple[int, int, bytes]], seed: int) -> None:
    one = wire(seed)
    for port, identifier, data in offers:
        one.offer(0, port, classical(identifier, data))
    got = [d.frame for d in run(one, 200_000_000)]
    assert set(got) == {classical(identifier, data) for _, identifier, data in offers}
    assert one.sent == len(offers) and not any(one.waiting(port) for port in range(5))


def test_bits_of_the_frames_are_what_the_tests_count_with() -> None:
    frame = classical(0x123)
    assert encode(frame).eof == sum(frame_bits(frame)) + TAIL - INTERMISSION
