"""Bisection against boundaries that are known, the interval against what it promises, and the command."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hil.cli import main
from hil.errors import UserError
from hil.lab.margin import Search, SeedMargin, Tried, bisect, checked, summary
from hil.lab.quantity import quantity
from hil.lab.statistics import median, median_interval, share_interval
from hil.scenario import load

STAND = load("stand")


def search(key: str, near: float | None = None, far: float | None = None, resolution: float | None = None) -> Search:
    return checked(Search(STAND, quantity(STAND, key), 2.0, near, far, resolution))


def attempts(stable: Callable[[float], bool]) -> Callable[[float], Tried]:
    return lambda value: Tried(value, stable(value), "", {})


@settings(max_examples=60)
@given(st.floats(0.0, 0.03), st.sampled_from([1e-4, 3e-4, 1e-3]))
def test_a_known_boundary_is_found_to_the_resolution(boundary: float, resolution: float) -> None:
    found = bisect(search("link.command.delay", 0.0, 0.03, resolution), 0, attempts(lambda v: v <= boundary))
    assert found.stable is not None and found.stable <= boundary
    if found.unstable is None:
        assert found.stable == 0.03
    else:
        assert boundary < found.unstable <= found.stable + resolution * 1.001
    values = [run.value for run in found.tried]
    assert len(set(values)) == len(values) <= 2 + math.ceil(math.log2(0.03 / resolution) + 1)


@settings(max_examples=60)
@given(st.floats(-6.0, 0.8))
def test_without_a_range_the_ends_are_found_over_decades(exponent: float) -> None:
    boundary = 10.0**exponent
    found = bisect(search("link.command.delay"), 0, attempts(lambda v: v <= boundary))
    assert found.stable is not None and found.unstable is not None
    assert found.stable <= boundary < found.unstable
    assert found.unstable - found.stable <= found.unstable / 60 or found.unstable < 1e-9


def test_a_factor_is_searched_from_its_nominal_value() -> None:
    found = bisect(search("joint.torque_gain"), 0, attempts(lambda v: v <= 2.6))
    assert found.tried[0].value == 1.0 and found.tried[1].value == 1.25
    assert found.stable == pytest.approx(2.6, abs=0.05)


def test_a_range_may_go_down() -> None:
    found = bisect(search("joint.torque_gain", 1.0, 0.1, 0.01), 0, attempts(lambda v: v >= 0.333))
    assert (found.stable, found.unstable) == (0.34, 0.33)
    result = summary(search("joint.torque_gain", 1.0, 0.1), [found, found])
    assert result["margin"] == 0.34


def test_whole_numbers_stay_whole() -> None:
    found = bisect(search("bus.left_leg.background.identifiers"), 0, attempts(lambda v: v <= 37))
    assert (found.stable, found.unstable) == (37, 38)


@pytest.mark.parametrize(
    ("key", "end"),
    [("bus.left_leg.loss", 1.0), ("link.command.delay", STAND.duration - 2.0), ("joint.torque_gain", 1 + 2**18)],
)
def test_where_all_is_stable_the_bound_is_reached_and_said(key: str, end: float) -> None:
    searched = search(key)
    found = bisect(searched, 5, attempts(lambda _: True))
    assert found.stable == pytest.approx(end) and found.unstable is None
    result = summary(searched, [found])
    assert (result["margin"], result["open"], result["stable_to"]) == (None, 1, found.stable)


def test_unstable_from_the_start_is_no_margin() -> None:
    searched = search("link.command.delay")
    found = bisect(searched, 0, attempts(lambda _: False))
    assert (found.stable, found.unstable, len(found.tried)) == (None, 0.0, 1)
    result = summary(searched, [found])
    assert result["margin"] is None and result["unstable_at_start"] == 1
    json.dumps(result, allow_nan=False)


def test_the_summary_counts_open_ends_as_infinite() -> None:
    one = SeedMargin(0, 0.010, 0.011, ())
    result = summary(search("link.command.delay"), [one, SeedMargin(1, 0.02, None, ()), SeedMargin(2, None, 0.0, ())])
    assert result["margin"] == 0.010
    assert (result["interval"]["low"], result["interval"]["high"]) == (None, None)
    assert (result["open"], result["unstable_at_start"]) == (1, 1)


# --- statistics ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "confidence", "inside"),
    [(1, 0, 1), (2, 0.5, 2), (4, 0.875, 4), (5, 0.9375, 5), (6, 0.96875, 6), (8, 0.9921875, 8), (9, 0.9609375, 7)],
)
def test_the_interval_of_the_median_is_that_of_the_tables(n: int, confidence: float, inside: int) -> None:
    """Conover 1999, table A3 (binomial, p = 1/2)."""
    interval = median_interval(range(n))
    assert interval.confidence == pytest.approx(confidence)
    assert interval.high - interval.low + 1 == inside


def test_the_interval_holds_the_median_as_often_as_it_says() -> None:
    rng = np.random.default_rng(7)
    draws = rng.lognormal(size=(4000, 9))
    hits = sum(low <= 1.0 <= high for low, high, _ in map(median_interval, draws.tolist()))
    assert hits / 4000 == pytest.approx(median_interval(range(9)).confidence, abs=0.01)


def test_of_two_in_the_middle_the_median_is_the_lower() -> None:
    assert median([3.0, 1.0, math.inf, 2.0]) == 2.0


@pytest.mark.parametrize(("count", "n"), [(0, 8), (3, 8), (8, 8)])
def test_a_share_s_interval_is_clopper_and_pearson_s(count: int, n: int) -> None:
    low = stats.beta.ppf(0.025, count, n - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, n - count) if count < n else 1.0
    assert share_interval(count, n)[:2] == pytest.approx((low, high))


# --- the command --------------------------------------------------------------------------------------

QUICK = ["--duration", "1.2s", "--set", "limits.settle=1s", "--set", "world.hoist.hold=0.3s", "--set",
         "world.hoist.release=0.2s", "--set", "controller.stand_at=0.2s"]  # fmt: skip


def test_the_command_finds_the_jump_that_the_watchdog_bears(
    capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    """Delay by a jump starves the drives, which bear 5 ms without a command: the boundary is known."""
    arguments = ["margin", "stand", "--of", "link.command.delay", "--range", "0ms..16ms", "--resolution", "1ms",
                 "--at", "0.9s", "--seeds", "2", "--jobs", "2", *QUICK]  # fmt: skip
    assert main([*arguments, "--json", "--out", str(tmp_path / "m")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["of"], result["unit"], result["at"]) == ("link.command.delay", "s", 0.9)
    assert 3e-3 <= result["margin"] <= 5e-3
    for number, seed in enumerate(result["per_seed"]):
        assert seed["seed"] == number and seed["unstable"] == pytest.approx(seed["stable"] + 1e-3)
        assert "quick stop" in next(run["reason"] for run in seed["tried"] if run["value"] == 16e-3)
    assert json.loads((tmp_path / "m" / "margin.json").read_text()) == result
    assert (tmp_path / "m" / "margin.png").stat().st_size > 5000
    page = (tmp_path / "m" / "margin.html").read_text()
    assert "order statistics" in page and "src=\"data:image/png" in page and "http" not in page


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--of", "link.command.dely"], "did you mean 'link.command.delay'"),
        (["--of", "firmware.law"], "has no margin, it is no number"),
        (["--of", "link.command.delay", "--range", "3ms"], "expected NEAR..FAR"),
        (["--of", "link.command.delay", "--range", "3..4"], "has no unit"),
        (["--of", "link.command.delay", "--range", "3ms..3ms"], "nothing to bisect"),
        (["--of", "bus.left_leg.loss", "--range", "0..2"], "expected 0 to 1"),
        (["--of", "link.command.delay", "--at", "90s"], "the scenario ends at 10 s"),
        (["--of", "link.command.delay", "--at", "soon"], "--at: 'soon' is not a number"),
        (["--of", "link.command.delay", "--resolution", "0"], "expected more than 0"),
        (["--of", "link.command.delay", "--seeds", "0"], "expected 1, 2, 3"),
    ],
)
def test_a_mistake_is_told_in_one_sentence(options: list[str], message: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["margin", "stand", *options]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1


def test_a_wrong_range_is_the_user_s() -> None:
    with pytest.raises(UserError, match="expected 0 s to"):
        search("link.command.delay", 0.0, 2e6)


def test_what_was_found_is_said_in_words() -> None:
    from hil.report.margin_page import sentences

    searched = search("link.command.delay")

    def said(*found: SeedMargin) -> list[str]:
        return sentences(summary(searched, found), searched.quantity)

    both = said(SeedMargin(0, 0.010, 0.011, ()), SeedMargin(1, 0.02, None, ()))
    assert both[0] == "margin      10 ms, the median of 2 seeds"
    held = "holds the median of all seeds with 50 % (order statistics)"
    assert both[1] == f"confidence  10 ms to beyond the search {held}"
    assert both[2] == "by seed     10 ms, 20 ms or beyond"
    assert said(SeedMargin(0, 8.0, None, ()))[0] == "margin      none found: stable up to 8 s, where the search ended"
    tried = (Tried(0.0, False, "", {}),)
    assert said(SeedMargin(0, None, 0.0, tried))[0] == "margin      none: unstable at 0 s already"
