"""What the bandwidth study makes of numbers, against numbers that are known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hil.lab.axes import Axis
from hil.lab.linear.linearisation import Mode
from hil.lab.linear.questions import oscillation
from hil.lab.quantity import quantity
from hil.report.study_page import write_study
from hil.scenario import load
from hil.studies import bandwidth as study
from hil.studies.study import Answers

STAND = load("stand")


def answers(rows: list, scenario=STAND, **axes: tuple[float, ...]) -> Answers:
    made = tuple(Axis(quantity(scenario, key.replace("__", ".")), values) for key, values in axes.items())
    return Answers(scenario, made, rows)


def mode(natural: float, damping: float, name: str) -> Mode:
    """Of s² + 2 ζ w s + w² = 0."""
    growth, omega = -damping * natural, natural * math.sqrt(1.0 - damping**2)
    return Mode(np.exp((growth + 1j * omega) / 1500), growth, omega / (2.0 * math.pi), ((name, 1.0),))


def test_the_least_damped_oscillation_is_found_by_its_ratio_within_the_band() -> None:
    slow, wanted, fast = mode(1.0, 0.01, "slow"), mode(30.0, 0.2, "wanted"), mode(4000.0, 0.05, "fast")
    lively = mode(100.0, 0.3, "lively")
    found = oscillation(SimpleNamespace(modes=(slow, lively, wanted, fast), doubt=lambda: None))  # type: ignore[arg-type]
    assert found["mode"] == "wanted 100 %"
    assert found["damping"] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("reached", "verdict", "told"),
    [
        ([3.0, 2.0, 1.5], "holds", "rises by 100 %"),
        ([2.0, 3.0, 1.5], "holds in part", "rises by 100 % down to a torque bandwidth of 20 Hz, and falls by 33 %"),
        ([1.0, 2.0, 4.0], "does not hold", "falls by 75 %"),
        ([2.0, 2.0, 2.01], "does not hold", "does not change"),
        ([math.inf, 0.0, 2.0], "does not hold", "cannot be told"),
    ],
)
def test_trade(reached: list[float], verdict: str, told: str) -> None:
    found = study.trade(np.array([10.0, 20.0, 40.0]), np.array(reached))
    assert found[0] == verdict
    assert told in found[1]


@pytest.mark.parametrize(
    ("without", "with_it", "verdict"),
    [
        ([0.5, 0.2], [0.1, 0.1], "holds"),
        ([0.5, 0.2], [0.3, 0.1], "holds in part"),
        ([0.2, 0.2], [0.1, 0.1], "holds in part"),
        ([0.2, 0.5], [0.6, 0.1], "does not hold"),
    ],
)
def test_make_up(without: list[float], with_it: list[float], verdict: str) -> None:
    found, numbers = study.make_up(np.array([10.0, 40.0]), np.array(without), np.array(with_it), 3.0)
    assert found == verdict
    assert f"{100 * without[0]:.1f} % at 10 Hz" in numbers[0]


def test_zero_crossing_of_a_line() -> None:
    delay = np.array([0.0, 2.0, 5.0])
    assert study.zero_crossing(delay, 0.3 - 0.1 * delay) == pytest.approx(3.0)
    assert study.zero_crossing(delay, 0.3 + delay) == math.inf
    assert study.zero_crossing(delay, -0.1 - delay) == 0.0


def test_boundaries_of_loops_and_runs() -> None:
    rows = [
        {"refused": None, "value": 2.0, "unstable_at_start": False},
        {"refused": None, "value": None, "unstable_at_start": True},
        {"refused": None, "value": None, "unstable_at_start": False},
        {"refused": "falls"},
        {"refused": None, "doubt": "not to be trusted", "value": 1.0, "unstable_at_start": False},
    ]
    found = study.limits(answers(rows, joint__torque_feedback=(0.5, 1.0, 2.0, 4.0, 8.0)))
    np.testing.assert_array_equal(found, [2.0, 0.0, np.inf, np.nan, np.nan])
    shares = [1, 1, 0, 1, 0.5, 0, 0, 0, 0, 1, 1, 1]  # stable again beyond what is not: does not count
    runs = answers(
        [{"share": share} for share in shares],
        joint__torque_feedback=(0.5, 1.0, 2.0),
        controller__task_bandwidth=(1.0, 2.0, 3.0, 4.0),
    )
    np.testing.assert_array_equal(study.largest_stable(runs), [2.0, 1.0, 0.0])


def test_torque_bandwidths_rise_with_the_feedback() -> None:
    found = study.torque_bandwidths(STAND, [0.25, 1.0, 4.0])
    assert (np.diff(found) > 5.0).all()


def test_findings_and_their_page_from_answers_that_are_made_up(tmp_path) -> None:
    factors = (0.5, 2.0)
    wave = {"refused": None, "growth": -1.0, "frequency": 5.0, "mode": "CoM x 50 %"}
    split = load("split-terrain")
    found = {
        "predicted": answers(
            [{**wave, "value": v, "unstable_at_start": False} for v in (3.0, 2.0)], joint__torque_feedback=factors
        ),
        "runs": answers(
            [{"share": s} for s in (1.0, 1.0, 1.0, 0.0)],
            joint__torque_feedback=factors, controller__task_bandwidth=(1.0, 4.0),
        ),
        "force": answers(
            [
                {study._TRUE: e, study._ERROR: e, study._PLACE: 0.002, "share": 1.0, "ends": "stable"}
                for e in (0.5, 0.05, 0.2, 0.05)
            ],
            split, joint__torque_feedback=factors, controller__internal_force__gain=(0.0, 3.0),
        ),
        "latency": answers(
            [{**wave, "damping": d} for d in (0.2, 0.3, -0.1, 0.1)],
            link__command__delay=(0.0, 6e-3), controller__task_damping=(1.0, 2.0),
        ),
    }  # fmt: skip
    findings = study.conclude(found)
    assert [claim.verdict for claim in findings.claims] == ["holds", "holds", "holds"]
    text = " ".join(number for claim in findings.claims for number in claim.numbers)
    assert "it rises by 50 %" in text
    assert "0.200 to -0.100, 0.050 per millisecond" in text
    assert "4.0 ms with ×1, beyond 6 ms with ×2" in text
    page = write_study(tmp_path, study.STUDY, findings, ["nothing"]).read_text()
    assert page.count("data:image/png;base64,") == 3
    assert "http" not in page.replace("http://www.w3.org", "")
    assert {path.name for path in tmp_path.glob("*.png")} == {f"{field.name}.png" for field in findings.fields}


@pytest.mark.parametrize("quick", [False, True])
def test_every_part_can_be_loaded(quick: bool) -> None:
    assert all(part.count() > 1 for part in study.parts(quick))
