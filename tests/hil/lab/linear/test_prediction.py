"""Critical values against loops whose boundary is known by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from hil.cli import main
from hil.errors import UserError
from hil.lab.linear.delay_model import DelayModel
from hil.lab.linear.linearisation import Linearisation
from hil.lab.linear.prediction import Prediction, parting, predict
from hil.lab.margin import Search, SeedMargin, Tried
from hil.lab.quantity import Quantity, quantity
from hil.report.margin_page import search_end
from hil.scenario import load

PERIOD = 1e-3


class Integrator:
    """x(k+1) = x(k) − g x(k−d): with the delay d in periods, a mode on the unit circle at g = 2 sin(π / (4 d + 2))."""

    def __init__(self, of):
        self._of = of
        self.asked = []

    def with_value(self, quantity, value):
        self.asked.append(value)
        gain, delay = self._of(value)
        matrices = np.zeros((delay + 1, 1, 1))
        matrices[0] += 1.0
        matrices[delay] -= gain
        return Linearisation(DelayModel.of(matrices, PERIOD, 1e-12), ("level",), np.ones(1), 0.0, delay)


def search(near=None, far=None, resolution=None, nominal=0.05, unit="", kind="number"):
    varied = Quantity("controller.gain", kind, unit, 0.0, math.inf, nominal, injectable=False)
    return Search(load("stand"), varied, 5.0, near, far, resolution)


@pytest.mark.parametrize("delay", [1, 3, 8])
def test_the_critical_gain_of_a_delayed_integrator(delay):
    found = predict(Integrator(lambda gain: (gain, delay)), search(resolution=1e-6))
    known = 2.0 * math.sin(math.pi / (4 * delay + 2))
    assert found.value == pytest.approx(known, abs=2e-6)
    assert found.mode.frequency == pytest.approx(1.0 / ((4 * delay + 2) * PERIOD), rel=1e-3)


def test_the_critical_delay_is_between_two_periods():
    """A delay is a staircase: 2 sin(π / (4 d + 2)) falls below a gain of 0.3 between d = 4 and 5."""
    point = Integrator(lambda value: (0.3, math.floor(value / PERIOD)))
    found = predict(point, search(near=0.0, far=20e-3, resolution=1e-5, nominal=0.0, unit="s"))
    assert 2.0 * math.sin(math.pi / 18) > 0.3 > 2.0 * math.sin(math.pi / 22)
    assert found.value == pytest.approx(5e-3, abs=2e-5)
    assert len(point.asked) == len(set(point.asked)) < 25


def test_towards_smaller_values():
    found = predict(Integrator(lambda value: (1.0 / value, 1)), search(near=5.0, far=0.1, resolution=1e-5))
    assert found.value == pytest.approx(1.0, abs=2e-5)  # 2 sin(π / 6) = 1


def test_nothing_to_find():
    found = predict(Integrator(lambda gain: (0.1, 1)), search(near=0.0, far=3.0))
    assert (found.value, found.mode) == (None, None)
    assert [step.value for step in found.steps] == [0.0, 3.0]
    assert json.loads(json.dumps(found.record()))["predicted"] is None


@pytest.mark.parametrize("falls_from", [0.5, 0.9, 2.5])
def test_where_the_robot_does_not_stand_the_search_ends(falls_from):
    """With a delay of one period the boundary is 1; it is found if the robot stands there, and else why it is not."""

    def of(gain):
        if gain >= falls_from:
            raise UserError("does not stand")
        return gain, 1

    found = predict(Integrator(of), search(near=0.05, far=3.0, resolution=1e-4))
    if falls_from > 1.0:
        assert found.value == pytest.approx(1.0, abs=2e-4) and found.refused is None
        return
    assert (found.value, found.mode, found.refused) == (None, None, "does not stand")
    assert falls_from - 3.0 / 16 < found.furthest < falls_from
    assert search_end(found.record()) == "no further looked at: does not stand"


def test_unstable_from_the_start():
    found = predict(Integrator(lambda gain: (1.5, 1)), search(near=0.1, far=3.0))
    assert found.value is None and found.mode.growth > 0.0 and len(found.steps) == 1


def test_why_they_part():
    def told(margin, reasons=("foot slipped",), **world):
        scenario = load("stand", [f"world.{key}={value}" for key, value in world.items()])
        varied = quantity(scenario, "link.command.delay")
        return parting(Search(scenario, varied, 5.0), Prediction(6e-3, None, ()), margin, list(reasons))

    assert told(6.6e-3) is None and told(5.4e-3) is None and told(None) is None
    assert told(17e-3).startswith("11 ms beyond the prediction: dry friction")
    short = told(4.1e-3, ("watchdog", "watchdog", "fallen"))
    assert short.startswith("1.9 ms short of") and short.endswith("watchdog")
    assert "dry friction" not in told(17e-3, friction_scale=0)


def test_saturation_is_named_where_it_came_first():
    search = Search(load("stand", ["world.friction_scale=0"]), quantity(load("stand"), "link.command.delay"), 5.0)
    reasons, first = ["drive in fault: left_knee, command (8900h)", "fallen"], ["saturation, left_knee"] * 2
    for value, begins in ((6e-3, "2 ms short of"), (None, "the linear loop does not become unstable")):
        prediction = Prediction(value, None, ())
        told = parting(search, prediction, 4e-3, reasons, first)
        assert told.startswith(begins) and "saturation, left_knee came first, then a drive's protection: drive" in told
        assert "saturation" not in parting(search, prediction, 4e-3, reasons, ["slip, left_foot", *first[1:]])


def test_a_noisy_loop_is_not_to_be_trusted():
    noise = {1.0: 3.0, 2.0: 1e-3}

    class Noisy(Integrator):
        def with_value(self, quantity, value):
            return replace(super().with_value(quantity, value), noise=noise[math.ceil(value)])

    across = search(near=0.1, far=2.0, resolution=1e-4)
    assert "not to be trusted: a noise of 3 " in predict(Noisy(lambda gain: (gain, 1)), across).doubt
    noise[1.0] = 1e-3
    assert predict(Noisy(lambda gain: (gain, 1)), across).doubt is None


def test_the_command_warns_of_a_loop_that_is_not_to_be_trusted(monkeypatch, capsys):
    class Noisy:
        """In place of the standing robot."""

        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def linearise(self, scale=None):
            return replace(Integrator(lambda _: (0.1, 1)).with_value(None, 0.0), noise=7.0, scale=scale or 0.05)

    monkeypatch.setattr("hil.lab.linear.operating_point.OperatingPoint", Noisy)
    assert main(["linearise", "stand"]) == 0
    told = capsys.readouterr().out
    assert "caution     not to be trusted: a noise of 7 displacements" in told
    assert "displacements of 0.05 of their usual size" in told


def test_the_command(capsys, tmp_path):
    status = main([
        "linearise", "stand", "--at", "2.5s", "--of", "link.command.delay", "--range", "4ms..6ms", "--resolution",
        "0.3ms", "--json", "--out", str(tmp_path),
    ])  # fmt: skip
    record = json.loads(capsys.readouterr().out)
    assert status == 0 and record["growth"] < 0
    prediction = record["prediction"]
    assert (prediction["of"], prediction["unit"]) == ("link.command.delay", "s")
    assert 4.2e-3 < prediction["predicted"] < 5.4e-3  # 4.72 ms to 4.80 ms were bisected in whole runs
    assert 15 < prediction["mode"]["frequency"] < 20
    assert "controller's internal force" in list(prediction["mode"]["participation"])[:2]
    assert json.loads((tmp_path / "linearise.json").read_text(encoding="utf-8")) == record
    page = (tmp_path / "linearise.html").read_text(encoding="utf-8")
    assert "there the loop becomes unstable" in page and page.count("data:image/png") == 2
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("eigenvalues.png", "path.png"))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--range", "1ms..2ms"], "--range and --resolution go with --of"),
        (["--of", "link.command.jitter_shape"], "no margin"),
        (["--of", "link.comand.delay"], "did you mean 'link.command.delay'?"),
        (["--at", "soon"], "--at"),
    ],
)
def test_mistakes(arguments, sentence, capsys):
    assert main(["linearise", "stand", *arguments]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


@pytest.mark.parametrize(("margin", "why"), [(5e-3, None), (17e-3, "dry friction")])
def test_beside_a_margin(margin, why, monkeypatch, capsys):
    runs = (Tried(margin, True, "stood", {}), Tried(margin + 1e-4, False, "foot slipped", {}))
    found = [SeedMargin(0, margin, margin + 1e-4, runs)]
    monkeypatch.setattr("hil.lab.margin.margins", lambda *_: found)
    monkeypatch.setattr("hil.lab.linear.prediction.predicted", lambda *_: Prediction(4.7e-3, None, ()))
    arguments = ["margin", "stand", "--of", "link.command.delay", "--seeds", "1", "--predict"]
    assert main([*arguments, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["margin"], record["predicted"], record["unit"]) == (margin, 4.7e-3, "s")
    assert record["parting"] is None if why is None else why in record["parting"]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert "predicted   4.7 ms" in told and (why is None or why in told)
