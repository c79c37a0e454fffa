"""Impairments against their distributions; no fault disturbs the draws of another."""

import itertools
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from bus.config import Impairment
from bus.impairment import HELD_NS, NEVER, ImpairmentModel, Line
from hil.streams import streams


def model(seed: int = 1, **values: Any) -> ImpairmentModel:
    return ImpairmentModel("link", Impairment.model_validate(values), streams(seed))


def test_loss_delay_and_jitter_follow_their_parameters() -> None:
    m = model(delay="2ms", jitter="1ms", loss=0.1)
    n = 20_000
    assert sum(m.lost() for _ in range(n)) / n == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / n))
    extra = [m.extra_ns() for _ in range(n)]
    assert 2_000_000 <= min(extra) < 2_001_000 and 2_999_000 < max(extra) < 3_000_000
    assert sum(extra) / n == pytest.approx(2_500_000, abs=4 * 1e6 / math.sqrt(12 * n))


@pytest.mark.parametrize("rate, bits", [(1e-3, 200), (0.01, 50)])
def test_damage_has_the_distribution_of_independent_bits(rate: float, bits: int) -> None:
    m = model(bit_error_rate=rate)
    n = 20_000
    hits = [bit for bit in (m.damaged_at(bits) for _ in range(n)) if bit is not None]
    p = 1 - (1 - rate) ** bits
    assert len(hits) / n == pytest.approx(p, abs=4 * math.sqrt(p * (1 - p) / n))
    assert min(hits) >= 0 and max(hits) < bits
    # P(first damaged bit < k | damaged) is (1 - (1 - rate)^k) / p
    k = bits // 2
    half = (1 - (1 - rate) ** k) / p
    assert sum(h < k for h in hits) / len(hits) == pytest.approx(half, abs=4 * math.sqrt(0.25 / len(hits)))


def test_certain_and_impossible_damage() -> None:
    assert model(bit_error_rate=1.0).damaged_at(100) == 0
    assert model().damaged_at(100) is None
    assert model(bit_error_rate=5e-324).damaged_at(100) is None


@given(st.lists(st.sampled_from(["loss", "jitter", "bit_error_rate"]), unique=True))
@settings(deadline=None)
def test_an_injected_fault_leaves_the_draws_of_the_others_alone(injected: list[str]) -> None:
    def draws(m: ImpairmentModel, inject: list[str]) -> dict[str, list[object]]:
        seen: dict[str, list[object]] = {"loss": [], "jitter": [], "bit_error_rate": []}
        for n in range(40):
            if n == 20:
                for key in inject:
                    m.set(key, 0.0)
            if n == 30:
                for key in inject:
                    m.set(key, 0.5)
            seen["loss"].append(m.lost())
            seen["jitter"].append(m.extra_ns())
            seen["bit_error_rate"].append(m.damaged_at(3))
        return seen

    config: dict[str, Any] = {"jitter": "500ms", "loss": 0.5, "bit_error_rate": 0.5}
    undisturbed, disturbed = draws(model(**config), []), draws(model(**config), injected)
    for key in undisturbed:
        assert (disturbed[key] == undisturbed[key]) or key in injected
        assert disturbed[key][:20] == undisturbed[key][:20]
        if key in injected:  # paused for ten draws, then on from where the stream stood
            assert disturbed[key][30:] == undisturbed[key][20:30]


def test_each_kind_of_fault_asks_for_a_stream_of_its_own() -> None:
    asked: list[str] = []

    def factory(name: str) -> Any:
        asked.append(name)
        return streams(1)(name)

    ImpairmentModel("link.state", Impairment(), factory)
    assert len(set(asked)) == len(asked) == 9 and all(name.startswith("link.state.") for name in asked)


def test_a_restored_model_draws_the_same_again() -> None:
    m = model(delay="1ms", jitter="1ms", loss=0.5, bit_error_rate=0.01)
    for _ in range(7):
        m.lost(), m.extra_ns(), m.damaged_at(90)
    saved = m.snapshot()
    first = [(m.lost(), m.extra_ns(), m.damaged_at(90)) for _ in range(50)]
    m.set("loss", 0.0)
    m.set("delay", 0.5)
    m.restore(saved)
    assert [(m.lost(), m.extra_ns(), m.damaged_at(90)) for _ in range(50)] == first


def test_wrong_keys_and_values_are_refused() -> None:
    m = model()
    for unknown in ("latency", "burst", "burst.length", ""):
        with pytest.raises(KeyError, match="bit_error_rate"):
            m.set(unknown, 1.0)
    wrong: tuple[tuple[str, Any], ...] = (
        ("loss", 1.5), ("loss", -0.1), ("delay", -1e-3), ("jitter", math.nan), ("delay", math.inf), ("delay", "3ms"),
        ("burst.enter", 2.0), ("jitter_shape", "cauchy"), ("reorder", -1.0), ("duplicate", math.nan),
    )  # fmt: skip
    for key, value in wrong:
        with pytest.raises(ValueError, match=key):
            m.set(key, value)
    assert m.clean


JITTER = {
    "uniform": stats.uniform(0, 1),
    "normal": stats.halfnorm(0, 1),
    "exponential": stats.expon(),
    "lognormal": stats.lognorm(s=1.0, scale=math.exp(-0.5)),
    "pareto": stats.lomax(c=3.0, scale=2.0),
}


@pytest.mark.parametrize("shape", JITTER)
def test_jitter_has_the_distribution_of_its_name(shape: str) -> None:
    """Kolmogorov-Smirnov against scipy's distribution; a wrong one of the same mean is refused."""
    m = model(seed=2, jitter="1ms", jitter_shape=shape)
    draws = [m.extra_ns() * 1e-6 for _ in range(4000)]
    assert stats.kstest(draws, JITTER[shape].cdf).pvalue > 1e-3
    assert all(stats.kstest(draws, other.cdf).pvalue < 1e-6 for name, other in JITTER.items() if name != shape)
    if shape in ("exponential", "lognormal", "pareto"):
        assert JITTER[shape].mean() == pytest.approx(1.0)


def runs(flags: list[bool]) -> list[int]:
    """Lengths of the runs of True that end within ``flags``."""
    lengths, length = [], 0
    for flag in flags:
        if flag:
            length += 1
        elif length:
            lengths.append(length)
            length = 0
    return lengths


def test_bursts_have_the_length_and_share_of_the_gilbert_elliott_chain() -> None:
    enter, leave, n = 0.02, 0.25, 60_000
    m = model(burst={"enter": enter, "leave": leave})
    lost = [m.lost() for _ in range(n)]
    lengths = runs(lost)
    share, bursts = enter / (enter + leave), n * enter * leave / (enter + leave)
    assert len(lengths) == pytest.approx(bursts, rel=0.1)
    # geometric: mean 1/leave, variance (1 - leave) / leave²
    deviation = math.sqrt((1 - leave) / leave**2 / len(lengths))
    assert sum(lengths) / len(lengths) == pytest.approx(1 / leave, abs=4 * deviation)
    # the variance of the share of a two-state chain with correlation rho = 1 - enter - leave
    rho = 1 - enter - leave
    deviation = math.sqrt(share * (1 - share) / n * (1 + rho) / (1 - rho))
    assert sum(lost) / n == pytest.approx(share, abs=4 * deviation)
    for k in (1, 2, 5):  # P(lost k later | lost) of the chain
        again = [b for a, b in zip(lost, lost[k:], strict=False) if a]
        assert sum(again) / len(again) == pytest.approx(share + (1 - share) * rho**k, abs=0.05)


def test_a_burst_that_loses_a_part_and_a_burst_that_is_switched_off() -> None:
    m = model(burst={"enter": 1.0, "leave": 0.0, "loss": 0.3})
    n = 20_000
    assert sum(m.lost() for _ in range(n)) / n == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / n))
    m.set("burst.enter", 0.0)
    assert m.clean and not any(m.lost() for _ in range(100))


def changed(item: tuple[int, bytes], change: Any) -> tuple[int, bytes]:
    data = change(item[1])
    return item if data is item[1] else (item[0], data)


def arrivals(n: int = 2000, seed: int = 1, **values: Any) -> tuple[list[tuple[int, tuple[int, bytes]]], Line]:
    """What comes of ``n`` items that are sent 1 ms apart."""
    line = Line(model(seed, **values), changed)
    for k in range(n):
        line.send(k * 1_000_000, (k, k.to_bytes(8, "little")))
    return line.pop_due(NEVER), line


def test_duplicates_arrive_twice_and_in_their_share() -> None:
    n = 5000
    arrived, line = arrivals(n, duplicate=0.1)
    seen = [k for _, (k, _) in arrived]
    assert set(seen) == set(range(n)) and seen == sorted(seen)
    assert len(seen) - n == line.duplicated
    assert line.duplicated / n == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / n))


def test_corruption_flips_one_bit_of_its_share_anywhere_in_the_data() -> None:
    n = 5000
    arrived, line = arrivals(n, corruption=0.2)
    flipped = [int.from_bytes(data, "little") ^ k for _, (k, data) in arrived]
    assert all(bits.bit_count() <= 1 for bits in flipped) and len(arrived) == n
    hits = [bits for bits in flipped if bits]
    assert len(hits) == line.corrupted
    assert len(hits) / n == pytest.approx(0.2, abs=4 * math.sqrt(0.16 / n))
    assert {bits.bit_length() - 1 for bits in hits} == set(range(64))
    empty = Line(model(corruption=1.0), changed)
    empty.send(0, (0, b""))
    assert empty.pop_due(0) == [(0, (0, b""))] and empty.corrupted == 0


def test_reordered_deliveries_come_right_behind_the_next() -> None:
    n = 3000
    arrived, line = arrivals(n, reorder=0.25)
    order = [k for _, (k, _) in arrived]
    assert sorted(order) == list(range(n))
    late = [k for k, after in itertools.pairwise(order) if k > after]
    assert len(late) == line.reordered > n / 6
    position = {k: at for at, k in enumerate(order)}
    assert all(abs(position[k] - k) <= 1 for k in range(n - 1))
    assert all(arrival <= (k + 1) * 1_000_000 for arrival, (k, _) in arrived[:-1])
    # while one is held none is drawn: a hold every 1/p + 1 deliveries
    assert line.reordered / n == pytest.approx(0.25 / 1.25, abs=0.03)


def test_a_delivery_without_a_next_is_held_for_a_limited_time() -> None:
    line = Line(model(reorder=1.0), changed)
    line.send(5, (0, b""))
    assert line.next_ns == 5 + HELD_NS
    assert line.pop_due(5 + HELD_NS) == [(5 + HELD_NS, (0, b""))] and line.next_ns == NEVER
    line.send(NEVER // 2, (1, b""))  # behind nothing: the held one is gone
    assert [k for _, (k, _) in line.pop_due(NEVER)] == [1] and line.reordered == 0


EVERYTHING: dict[str, Any] = {
    "delay": "1ms", "jitter": "2ms", "jitter_shape": "lognormal", "loss": 0.1, "corruption": 0.3, "duplicate": 0.2,
    "reorder": 0.3, "burst": {"enter": 0.1},
}  # fmt: skip


@given(st.integers(0, 100), st.integers(0, 60))
@settings(deadline=None)
def test_a_restored_line_continues_identically(seed: int, steps: int) -> None:
    def loaded() -> tuple[ImpairmentModel, Line]:
        m = model(seed, **EVERYTHING)
        return m, Line(m, changed)

    def carry_on(line: Line, start: int) -> list[Any]:
        due = []
        for k in range(start, start + 40):
            line.send(k * 500_000, (k, bytes(8)))
            due += line.pop_due(k * 500_000)
        return due

    m, line = loaded()
    carry_on(line, 0)
    saved = m.snapshot(), line.snapshot()
    expected = carry_on(line, 40), line.snapshot()
    other_model, other = loaded()
    for k in range(steps):
        other.send(k, (k, b"x"))
    other_model.restore(saved[0])
    other.restore(saved[1])
    assert (carry_on(other, 40), other.snapshot()) == expected


def test_a_clean_line_draws_nothing() -> None:
    def no_draws(name: str) -> Any:
        return None  # any draw would fail

    line = Line(ImpairmentModel("link", Impairment(), no_draws), changed)
    for k in range(10):
        assert line.send(k, (k, b"x"))
    assert [k for _, (k, _) in line.pop_due(10)] == list(range(10))
