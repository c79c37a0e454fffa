"""Axes and points against numpy, scipy and the properties that the samples promise."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.errors import UserError
from hil.lab.axes import axis, points
from hil.scenario import load

STAND = load("stand")


def test_a_linear_axis_has_both_ends_and_short_numbers() -> None:
    delay = axis(STAND, "link.command.delay=0ms..10ms:21")
    assert delay.values == tuple(n * 5 / 10_000 for n in range(21))


def test_a_logarithmic_axis_has_equal_ratios() -> None:
    gain = axis(STAND, "joint.torque_gain=0.3..3:12:log")
    values = np.array(gain.values, float)
    assert (values[0], values[-1], len(values)) == (0.3, 3.0, 12)
    assert np.diff(np.log(values)) == pytest.approx(np.log(10) / 11)


def test_listed_values_are_taken_as_they_are() -> None:
    assert axis(STAND, "firmware.law=PD_m,PID_m").values == ("PD_m", "PID_m")
    assert axis(STAND, "link.state.delay=3ms, 500us,0").values == (3e-3, 5e-4, 0.0)
    assert axis(STAND, "controller.internal_force.feedback=true,false").values == (True, False)


def test_an_axis_of_whole_numbers_has_each_once() -> None:
    assert axis(STAND, "bus.left_leg.background.identifiers=1..3:9").values == (1, 2, 3)


def test_a_grid_is_the_product_with_the_last_axis_fastest() -> None:
    axes = [axis(STAND, "link.command.delay=0ms..2ms:3"), axis(STAND, "firmware.law=PD_m,PID_m")]
    assert points(axes) == list(itertools.product((0.0, 1e-3, 2e-3), ("PD_m", "PID_m")))


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 64), st.booleans())
def test_a_latin_hypercube_has_one_point_in_every_stripe_of_every_axis(count: int, log: bool) -> None:
    tail = ":log" if log else ""
    axes = [axis(STAND, f"link.command.delay=1ms..100ms{tail}", True), axis(STAND, "bus.left_leg.loss=0..1", True)]
    found = np.array(points(axes, f"lhs:{count}"))
    shares = np.log(found[:, 0] / 1e-3) / np.log(100) if log else (found[:, 0] - 1e-3) / 0.099
    for share in (shares, found[:, 1]):
        assert sorted(np.floor(share * count + 1e-9).astype(int)) == list(range(count))
    assert points(axes, f"lhs:{count}") == [tuple(row) for row in found.tolist()]  # every time the same


def test_sobol_points_halve_every_axis_evenly() -> None:
    axes = [axis(STAND, "link.command.delay=0ms..8ms", True), axis(STAND, "bus.left_leg.loss=0..1", True)]
    found = np.array(points(axes, "sobol:64"))
    for column, top in ((found[:, 0], 8e-3), (found[:, 1], 1.0)):
        assert np.histogram(column, bins=8, range=(0, top))[0].tolist() == [8] * 8


@pytest.mark.parametrize(
    ("text", "sampled", "message"),
    [
        ("link.command.delay", False, "expected KEY=LOW..HIGH:COUNT"),
        ("link.command.delay=", False, "expected KEY=LOW..HIGH:COUNT"),
        ("link.command.delay=0ms..3ms", False, "expected KEY=LOW..HIGH:COUNT"),
        ("link.command.delay=0ms..3ms:1", False, "2 or more"),
        ("link.command.delay=0ms..3ms:4.5", False, "2 or more"),
        ("link.command.delay=0ms..3ms:4:log", False, "begins above 0"),
        ("link.command.delay=3ms..0ms:4", False, "the lower end first"),
        ("link.command.delay=0..3:4", False, "has no unit"),
        ("link.command.delay=1ms,1ms", False, "listed twice"),
        ("link.command.dely=1ms", False, "did you mean 'link.command.delay'"),
        ("firmware.law=PD_m..PID_m:2", False, "is no number, list its values"),
        ("link.command.delay=0ms..3ms:4", True, "with --sample"),
        ("firmware.law=PD_m,PID_m", True, "with --sample"),
    ],
)
def test_wrong_axes_are_refused(text: str, sampled: bool, message: str) -> None:
    with pytest.raises(UserError, match=message):
        axis(STAND, text, sampled)


@pytest.mark.parametrize(
    ("sample", "message"),
    [("lhs", "lhs:N or sobol:N"), ("random:8", "lhs:N or sobol:N"), ("lhs:0", "lhs:N or sobol:N"),
     ("sobol:100", "powers of two")],
)  # fmt: skip
def test_wrong_samples_are_refused(sample: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        points([axis(STAND, "bus.left_leg.loss=0..1", True)], sample)


def test_an_axis_given_twice_and_too_many_points_are_refused() -> None:
    loss = axis(STAND, "bus.left_leg.loss=0..1:1000")
    with pytest.raises(UserError, match="given twice"):
        points([loss, loss])
    with pytest.raises(UserError, match="--sample takes fewer"):
        points([loss, axis(STAND, "bus.right_leg.loss=0..1:1000")])
