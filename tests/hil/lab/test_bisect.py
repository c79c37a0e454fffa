"""What makes the one of two configurations unstable, where it is known."""

import itertools
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.cli import main
from hil.errors import UserError
from hil.lab.bisect import bisect, changes, ddmin, side
from hil.run import Request, run
from hil.scenario import load

SHORT = ["duration=0.1s", "controller.stand_at=0.02s"]
FALLS = ["limits.fall_height=1.5"]  # by the book: the height at the start is less than that of a fall
HARMLESS = ["link.command.delay=1ms", "bus.left_leg.loss=0.01", "firmware.watchdog=20ms", "sensors.noise=2.0"]


@given(st.integers(1, 12).flatmap(lambda n: st.tuples(st.just(n), st.sets(st.integers(0, n - 1), min_size=1))))
def test_ddmin_finds_exactly_what_is_needed(case: tuple[int, set[int]]) -> None:
    n, needed = case
    found = ddmin(list(range(n)), lambda subset: "unstable" if needed <= set(subset) else "stable")
    assert set(found) == needed


@given(st.lists(st.sets(st.integers(0, 7), min_size=1), min_size=1, max_size=3), st.sets(st.integers(0, 7)))
def test_ddmin_is_minimal_with_several_causes_and_what_cannot_be_run(causes: list[set[int]], odd: set[int]) -> None:
    """Any one cause is enough; a subset with some members of ``odd``, but not all, cannot be run."""

    def test(subset: list[int]) -> str:
        some = odd & set(subset)
        if some and some != odd:
            return "unresolved"
        return "unstable" if any(cause <= set(subset) for cause in causes) else "stable"

    found = ddmin(list(range(8)), test)  # type: ignore[arg-type]
    assert test(found) == "unstable"
    assert all(test([m for m in found if m != left_out]) != "unstable" for left_out in found)


def test_the_parameter_responsible(capsys: pytest.CaptureFixture) -> None:
    given_ = itertools.chain.from_iterable(("--set", text) for text in SHORT)
    sets = itertools.chain.from_iterable(("--unstable-set", text) for text in [*HARMLESS, *FALLS])
    assert main(["bisect", "stand", *given_, *sets, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["responsible"] == ["limits.fall_height: 0.6 → 1.5"] and told["of"] == 5
    assert told["reason"].startswith("fallen")


def test_two_that_only_together_do_harm() -> None:
    """A cable that is off for 15 ms, and a watchdog that does not wait that long."""
    cut = "inject=[{at='100ms', until='115ms', key='bus.left_leg.node.left_knee.cut', value=true}]"
    scenario = ["duration=0.15s", "controller.stand_at=0.05s", "firmware.watchdog=100ms"]
    unstable = side("stand", [*scenario, "sensors.noise=2.0", "firmware.watchdog=5ms", cut], None)
    found = bisect(side("stand", scenario, None), unstable)
    assert sorted(change.name.split()[0] for change in found.changes) == ["firmware.watchdog:", "inject"]
    assert "watchdog" in found.reason and found.candidates == 3


def test_records_and_what_was_injected_into_them_by_hand(tmp_path: Path) -> None:
    scenario = load("stand", SHORT)
    run(Request(scenario, 2, "inline", out=tmp_path / "a", report=False))

    def meddle(assembly: object) -> None:
        system = assembly.system  # type: ignore[attr-defined]
        system.requests.append(lambda: system.inject("bus.left_leg.delay", "2ms"))

    run(Request(scenario, 5, "inline", out=tmp_path / "b", report=False), prepare=meddle)
    found = changes(side(str(tmp_path / "a"), [], None), side(str(tmp_path / "b"), [], None))
    assert [change.name for change in found] == [
        "seed: 2 → 5",
        "inject with at 0.00027 s, key bus.left_leg.delay, value 2ms",
    ]


def test_lists_are_compared_by_entry() -> None:
    push = "{at='1s', duration='1s', force=['1N', '0N', '0N']}"
    other = "{at='2s', duration='1s', force=['9N', '0N', '0N']}"
    found = changes(side("stand", [f"push=[{push}]"], None), side("stand", [f"push=[{push}, {other}]"], None))
    assert len(found) == 1 and found[0].name.startswith("push with at 2.0 s")


@pytest.mark.parametrize(
    ("stable", "unstable", "sentence"),
    [
        (FALLS, FALLS, "stand and stand do not differ in anything that matters"),
        (FALLS, HARMLESS, "stand is not stable: fallen"),
        (HARMLESS, [], "stand is not unstable: stood to the end"),
    ],
)
def test_what_cannot_be_bisected(stable: list[str], unstable: list[str], sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        bisect(side("stand", [*SHORT, *stable], None), side("stand", [*SHORT, *unstable], None))


def test_the_record_of_a_run_takes_no_settings(tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").write_text("")
    with pytest.raises(UserError, match="is the record of a run, which takes no settings"):
        side(str(tmp_path), ["duration=1s"], None)
