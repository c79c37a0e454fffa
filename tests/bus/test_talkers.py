"""What talks on a bus and means nothing: it takes the share it should, and starves whom arbitration lets it starve."""

import pickle
from itertools import pairwise
from typing import Any

import pytest
from scipy import stats

from bus.config import BusConfig
from bus.frames import Frame
from bus.impairment import NEVER
from bus.talkers import Babbler, BackgroundTraffic, Talker
from bus.timing import frame_ns
from bus.wire import Delivery, Wire
from hil.streams import streams

MS = 1_000_000
BABBLE, BACKGROUND = 3, 4  # ports


def bus(seed: int = 1, **values: Any) -> tuple[Wire, Babbler, BackgroundTraffic]:
    config = BusConfig.model_validate(values)
    wire = Wire("leg", config, 5, streams(seed))
    return wire, Babbler(wire, BABBLE, config.babble), BackgroundTraffic(wire, BACKGROUND, config, streams(seed))


def run(
    wire: Wire, talkers: list[Talker], end: int, offers: list[tuple[int, int, Frame]] | None = None
) -> list[Delivery]:
    """All deliveries before ``end`` of talkers and of ``offers`` (time, port, frame)."""
    delivered, waiting = [], sorted(offers or [], key=lambda o: o[0])
    while True:
        now = min(wire.next_ns, *[t.next_ns for t in talkers], waiting[0][0] if waiting else NEVER)
        if now >= end:
            return delivered
        for talker in talkers:
            talker.advance(now)
        while waiting and waiting[0][0] <= now:
            wire.offer(*waiting.pop(0))
        if wire.next_ns <= now:
            delivered += wire.advance(now)


def test_who_is_off_sends_nothing() -> None:
    wire, babbler, background = bus()
    assert (babbler.next_ns, background.next_ns, wire.next_ns) == (NEVER, NEVER, NEVER)


def test_a_babbler_keeps_its_rate() -> None:
    wire, babbler, _ = bus(babble={"rate": "2kHz", "identifier": 0x123, "length": 16})
    delivered = run(wire, [babbler], 50 * MS)
    assert len(delivered) == 100
    assert {(d.sender, d.frame) for d in delivered} == {(BABBLE, Frame(0x123, bytes(16)))}
    assert {b.time - a.time for a, b in pairwise(delivered)} == {500_000}


def test_a_babbling_idiot_starves_exactly_the_lower_priorities() -> None:
    """Back to back at 0x100: what is of a lower identifier waits for one frame at most, the rest for ever."""
    wire, babbler, _ = bus(babble={"rate": "100kHz", "identifier": 0x100})
    babble = frame_ns(Frame(0x100, bytes(8)), 1e6, 5e6)
    offers = [(k * MS + 300_000, k % 3, Frame(0x0F0 + 7 * (k % 5), bytes([k]))) for k in range(40)]
    above = [f for _, _, f in offers if f.id < 0x100]
    delivered = run(wire, [babbler], 60 * MS, offers)
    others = [d for d in delivered if d.sender != BABBLE]
    assert [d.frame for d in others] == above and 0 < len(above) < len(offers)
    for (at, _, frame), d in zip([o for o in offers if o[2].id < 0x100], others, strict=True):
        assert d.time - at <= babble + frame_ns(frame, 1e6, 5e6)
    assert wire.busy_ns / (60 * MS) > 0.999  # back to back
    babbler.set("rate", 0.0, 60 * MS)  # and when it falls silent, what has waited gets through
    rest = run(wire, [babbler], 80 * MS)
    assert len([d for d in rest if d.sender == BABBLE]) <= 2
    assert {d.frame for d in rest if d.sender != BABBLE} == {f for _, _, f in offers if f.id >= 0x100}


@pytest.mark.parametrize("pattern, tolerance", [("periodic", 0.002), ("poisson", 0.03)])
@pytest.mark.parametrize("load, length", [(0.3, 8), (0.6, 64)])
def test_background_takes_the_share_that_it_is_given(pattern: str, tolerance: float, load: float, length: int) -> None:
    wire, _, background = bus(background={"load": load, "pattern": pattern, "length": length, "identifiers": 5})
    span = 2000 * MS
    delivered = run(wire, [background], span)
    assert wire.refused == 0
    assert wire.busy_ns / span == pytest.approx(load, rel=tolerance)
    assert {d.frame.id for d in delivered} == set(range(0x101, 0x106))
    assert all(len(d.frame.data) == length for d in delivered) and len({d.frame.data for d in delivered}) > 1000


def test_random_background_comes_at_random_times() -> None:
    """Exponential gaps (Kolmogorov-Smirnov), identifiers uniform (chi squared)."""
    wire, _, background = bus(background={"load": 0.2, "pattern": "poisson", "identifiers": 8})
    times, offer = [], wire.offer

    def noted(now: int, port: int, frame: Frame) -> bool:
        times.append((now, frame))
        return offer(now, port, frame)

    wire.offer = noted  # type: ignore[method-assign]
    run(wire, [background], 1000 * MS)
    gaps = [(b - a) * 0.2 / frame_ns(frame, 1e6, 5e6) for (a, frame), (b, _) in pairwise(times)]
    assert len(gaps) > 2000
    assert stats.kstest(gaps, stats.expon.cdf).pvalue > 1e-3
    counts = [sum(f.id == 0x101 + n for _, f in times) for n in range(8)]
    assert stats.chisquare(counts).pvalue > 1e-3


def test_what_is_injected_takes_effect_from_then_on() -> None:
    wire, babbler, background = bus()
    run(wire, [babbler, background], 10 * MS)
    babbler.set("identifier", 0x7, 10 * MS)
    assert babbler.next_ns == NEVER
    babbler.set("rate", 1000.0, 10 * MS)
    background.set("load", 0.5, 10 * MS)
    delivered = run(wire, [babbler, background], 30 * MS)
    assert sum(d.frame.id == 0x7 for d in delivered) == 20
    assert wire.busy_ns / (20 * MS) == pytest.approx(0.5 + 0.065, abs=0.02)
    background.set("load", 0.0, 30 * MS)
    assert background.next_ns == NEVER
    for talker in (babbler, background):
        with pytest.raises(KeyError, match="identifier"):
            talker.set("colour", 1, 0)


def test_restored_talkers_continue_identically() -> None:
    background = {"load": 0.4, "pattern": "poisson", "length": 24}
    values: dict[str, Any] = {"babble": {"rate": "3kHz"}, "background": background}
    wire, *talkers = bus(1, **values)
    run(wire, talkers, 20 * MS)
    saved = pickle.loads(pickle.dumps((wire.snapshot(), [t.snapshot() for t in talkers])))
    expected = run(wire, talkers, 40 * MS)
    other, *others = bus(1, **values)
    run(other, others, 7 * MS)
    other.restore(saved[0])
    for talker, state in zip(others, saved[1], strict=True):
        talker.restore(state)
    assert run(other, others, 40 * MS) == expected and len(expected) > 50
    assert wire.busy_ns == other.busy_ns


def test_a_classical_bus_gets_classical_frames() -> None:
    values = {"babble": {"rate": "1kHz", "length": 64}, "background": {"load": 0.5, "length": 12}}
    config = BusConfig.model_validate(values)
    wire = Wire("leg", config, 5, streams(1))
    talkers: list[Talker] = [
        Babbler(wire, BABBLE, config.babble, fd=False),
        BackgroundTraffic(wire, BACKGROUND, config, streams(1), fd=False),
    ]
    delivered = run(wire, talkers, 200 * MS)
    assert all(not d.frame.fd and not d.frame.brs and len(d.frame.data) == 8 for d in delivered)
    babble = frame_ns(Frame(0x001, bytes(8), False, False), 1e6, 5e6) / MS
    assert wire.busy_ns / (200 * MS) == pytest.approx(0.5 + babble, abs=0.02)
