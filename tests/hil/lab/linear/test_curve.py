"""Predicted boundaries over two quantities, against a loop whose boundary is known by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.errors import UserError
from hil.lab.linear import curve
from hil.lab.linear.agreement import agreement
from hil.lab.linear.curve import Critical, Curve, critical, remembered, sides
from hil.lab.linear.delay_model import DelayModel
from hil.lab.linear.linearisation import Linearisation
from hil.lab.places import places
from hil.lab.quantity import Quantity
from hil.scenario import load
from tests.hil.lab.made_up import swept
from tests.support.pages import Page

GAIN = Quantity("controller.gain", "number", "", 0.0, math.inf, 0.05, injectable=True)


def integrator(gain: float, delay: int) -> Linearisation:
    """x(k+1) = x(k) − g x(k−d): unstable from g = 2 sin(π / (4 d + 2)) on."""
    matrices = np.zeros((delay + 1, 1, 1))
    matrices[0] += 1.0
    matrices[delay] -= gain
    return Linearisation(DelayModel.of(matrices, 1e-3, 1e-12), ("level",), np.ones(1), 0.0, delay)


def boundary(delay: int) -> float:
    return 2.0 * math.sin(math.pi / (4 * delay + 2))


@pytest.mark.parametrize("guess", [None, 0.1, 0.3, 0.8, 1.9])
@pytest.mark.parametrize("delay", [1, 2, 4])
def test_the_boundary_is_found_from_any_guess(delay: int, guess: float | None) -> None:
    found = critical(lambda g: integrator(g, delay), delay, GAIN, 0.05, 2.0, guess)
    assert found.value == pytest.approx(boundary(delay), abs=2.0 / 200)
    assert found.across == delay and found.why == ""
    assert found.frequency == pytest.approx(1e3 / (4 * delay + 2), rel=0.05)  # e^{jπ/(2d+1)} at 1 kHz


@pytest.mark.parametrize("guess", [None, 0.2])
def test_where_there_is_none_it_says_why(guess: float | None) -> None:
    stable = critical(lambda g: integrator(g, 2), 2, GAIN, 0.05, 0.4, guess)
    assert (stable.value, stable.why, stable.nowhere) == (None, "stable up to 0.4", False)
    unstable = critical(lambda g: integrator(g, 2), 2, GAIN, 0.7, 2.0, None if guess is None else 1.0)
    assert (unstable.value, unstable.why, unstable.nowhere) == (None, "unstable at 0.7 already", True)

    def fallen(_: float) -> Linearisation:
        raise UserError("does not stand")

    assert critical(fallen, 2, GAIN, 0.05, 2.0, guess).why == "does not stand"


def test_continuation_saves_work() -> None:
    asked: list[float] = []

    def counted(g: float) -> Linearisation:
        asked.append(g)
        return integrator(g, 3)

    critical(remembered(counted, GAIN), 3, GAIN, 0.05, 2.0, None)
    alone = len(asked)
    asked.clear()
    critical(remembered(counted, GAIN), 3, GAIN, 0.05, 2.0, boundary(3) * 1.05)
    assert len(asked) < alone


def test_it_is_looked_for_outwards_from_the_scenario_s_own_value() -> None:
    assert sides(GAIN, 0.1, 2.0) == [(0.05, 2.0)]
    assert sides(GAIN, 0.01, 0.02) == [(0.05, 0.01)]
    assert sides(GAIN, 0.01, 2.0) == [(0.05, 2.0), (0.05, 0.01)]


def test_a_gap_parts_a_curve() -> None:
    points = (Critical(1.0, 10.0), Critical(2.0, None, "none"), Critical(3.0, 30.0), Critical(4.0, 40.0))
    found = Curve(GAIN, GAIN, 0.0, 50.0, points)
    assert found.segments(along_is_x=True) == [[(10.0, 1.0)], [(30.0, 3.0), (40.0, 4.0)]]
    assert found.segments(along_is_x=False) == [[(1.0, 10.0)], [(3.0, 30.0), (4.0, 40.0)]]


@pytest.mark.parametrize(
    ("stable_to", "point", "friction", "said"),
    [
        (0.011, Critical(1.0, 0.0105), 1.0, "the same, as far as the distance of the runs tells"),
        (0.019, Critical(1.0, 0.006), 1.0, "13 ms beyond the prediction: dry friction holds"),
        (0.019, Critical(1.0, 0.006), 0.0, "13 ms beyond the prediction, and not by growth from small deviations"),
        (0.005, Critical(1.0, 0.016), 1.0, "11 ms short of the prediction, and not by growth"),
        (0.019, Critical(1.0, None, "unstable at 0 s already", nowhere=True), 1.0, "lets grow"),
        (-1.0, Critical(1.0, 0.016), 1.0, "unstable at 0 s already: <slipped>"),
        (9.0, Critical(1.0, 0.016), 1.0, "stable up to 30 ms, where the sweep ends"),
    ],
)
def test_where_they_part_and_why(tmp_path: Path, stable_to: float, point: Critical, friction: float, said: str) -> None:
    scenario = load("split-terrain", [f"world.friction_scale={friction}"])
    axes = ["link.command.delay=0ms..30ms:16", "joint.torque_gain=1,2"]
    found = places(swept(tmp_path, axes, lambda _s, d, _g: d < stable_to, seeds=2, scenario=scenario))
    row = [place for place in found.rows if place[1] == 1.0]
    told = agreement(found, found.quantities[0], row, 0.0, 0.03, point)
    assert said in told.sentence
    assert told.measured == (pytest.approx(stable_to, abs=1.1e-3) if 0 < stable_to < 1 else None)


class Standing:
    """In place of a robot that stands: the integrator, whose delay grows with the torque loop's gain."""

    def __init__(self, *_: Any) -> None:
        self.delay = 1

    def __enter__(self) -> Standing:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    close = __exit__

    def elsewhere(self, quantity: Quantity, value: float) -> Standing:
        assert quantity.key == "joint.torque_gain"
        if value > 3.5:
            raise UserError("does not stand")
        moved = Standing()
        moved.delay = round(value)
        return moved

    def with_value(self, quantity: Quantity, value: float) -> Linearisation:
        assert quantity.key == "link.command.delay"
        return integrator(value * 50.0 + 1e-3, self.delay)  # without any gain nothing moves


def test_the_command_draws_them_and_says_where_they_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(curve, "OperatingPoint", Standing)
    axes = ["link.command.delay=0ms..30ms:16", "joint.torque_gain=1,2,3,4"]
    out = swept(tmp_path, axes, lambda _s, d, g: d < 0.021 / g, seeds=2)
    assert main(["map", str(out), "--predict"]) == 0
    printed = capsys.readouterr().out
    record = json.loads((out / "map.json").read_text())
    page = Page(out / "map.html")
    rows = page.rows(0)
    assert [row["across"] for row in record["predicted"]] == [1.0, 2.0, 3.0, 4.0]
    for row in record["predicted"][:3]:
        assert row["predicted"] == pytest.approx(boundary(round(row["across"])) / 50.0, abs=0.03 / 200)
        assert rows[f"{row['across']:g}"][1] == f"{1e3 * row['predicted']:.4g} ms"
        assert rows[f"{row['across']:g}"][3] == row["sentence"]
        assert f"joint.torque_gain {row['across']:g}: runs" in printed
    assert record["predicted"][3]["predicted"] is None
    assert rows["4"][1] == "–" and "does not stand" in rows["4"][3]
    assert '"predicted, linear loop"' in (out / "map.html").read_text()
