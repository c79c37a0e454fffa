"""Impairments against their distributions; no fault disturbs the draws of another."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.config import Impairment
from bus.impairment import ImpairmentModel
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
    assert len(set(asked)) == len(asked) == 3 and all(name.startswith("link.state.") for name in asked)


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
    with pytest.raises(KeyError, match="bit_error_rate"):
        m.set("latency", 1.0)
    wrong = ("loss", 1.5), ("loss", -0.1), ("delay", -1e-3), ("jitter", math.nan), ("delay", math.inf)
    for key, value in wrong:
        with pytest.raises(ValueError, match=key):
            m.set(key, value)
    assert m.clean
