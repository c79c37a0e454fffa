"""A branch against the run that it stands for; quantities against the schema and the scenarios that they make."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.errors import UserError
from hil.lab.experiment import Branch, Experiment, outcome
from hil.lab.quantity import changed, quantity
from hil.run import Request, run
from hil.scenario import load
from robots import description

# a short standing-up with noise and jitter on
QUICK = [
    "duration=1.2s", "limits.settle=1s", "world.hoist.hold=0.3s", "world.hoist.release=0.2s",
    "controller.stand_at=0.2s", "link.state.jitter=50us",
]  # fmt: skip
SPLIT = load("split-terrain", QUICK)


@pytest.fixture(scope="module")
def branch():
    with Branch(SPLIT, seed=3, at=0.8) as settled:
        yield settled


@pytest.mark.parametrize(
    "values", [{}, {"link.command.delay": "3 ms"}, {"link.state.loss": 0.2, "bus.left_leg.jitter": "40 us"}]
)
def test_a_continuation_is_to_the_bit_the_run_that_injects_the_same(branch: Branch, values: dict) -> None:
    branch.outcome({"link.command.delay": "30 ms"})  # what ran before must leave nothing behind
    injections = ", ".join(f'{{at="0.8s", key="{k}", value={v!r}}}' for k, v in values.items())
    whole = run(Request(load("split-terrain", [*QUICK, f"inject=[{injections}]"]), seed=3, backend="inline"))
    continued = branch.outcome(values)
    assert continued.digest == whole.record["log_digest"]
    assert continued.metrics == whole.record["metrics"]
    assert (continued.stable, continued.reason) == (whole.stable, whole.record["reason"])


def test_a_continuation_ends_where_it_fails_and_the_next_one_does_not(branch: Branch) -> None:
    failed = branch.outcome({"bus.left_leg.node.gateway.cut": True})
    assert not failed.stable and failed.simulated < 1.2
    assert branch.outcome({}).simulated == pytest.approx(1.2)


def test_an_experiment_is_the_run() -> None:
    scenario = load("stand", ["duration=0.2s"])
    assert outcome(scenario, 1).digest == run(Request(scenario, seed=1, backend="inline")).record["log_digest"]


def test_wrong_injections_are_refused_at_once(branch: Branch) -> None:
    for values, message in (
        ({"controller.rate": "1 kHz"}, "controller.rate cannot be changed while a run goes on"),
        ({"link.command.dely": "3 ms"}, "did you mean 'link.command.delay'"),
        ({"link.command.delay": "3"}, "has no unit"),
    ):
        with pytest.raises(UserError, match=message):
            branch.outcome(values)
    with pytest.raises(UserError, match=r"nothing happens after 2 s: the scenario ends at 1\.2 s"):
        Branch(SPLIT, seed=0, at=2.0)


def test_a_stance_that_cannot_be_is_the_user_s_mistake() -> None:
    with pytest.raises(UserError, match="stance"):
        Experiment(load("stand", ["stance.hip_height=2m"]), seed=0)


def test_quantities_know_unit_bounds_and_nominal_value() -> None:
    delay = quantity(SPLIT, "link.command.delay")
    assert (delay.unit, delay.low, delay.high, delay.nominal, delay.injectable) == ("s", 0, 1e6, 0.0, True)
    assert delay.parse("3ms") == 3e-3 and delay.shown(0.0031234) == "3.123 ms" and delay.written(3e-3) == "0.003 s"
    rate = quantity(SPLIT, "controller.rate")
    assert (rate.unit, rate.nominal, rate.injectable, rate.high) == ("Hz", 1500.0, False, math.inf)
    loss = quantity(SPLIT, "bus.left_leg.loss")
    assert (loss.unit, loss.low, loss.high) == ("", 0.0, 1.0)
    law = quantity(SPLIT, "firmware.law")
    assert law.kind == "text" and "PID_m" in law.choices and not law.numeric
    assert quantity(SPLIT, "controller.internal_force.feedback").parse("false") is False


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("link.command.delay", "3", "link.command.delay: '3' has no unit"),
        ("link.command.delay", "-1ms", "link.command.delay = -1 ms: expected 0 s to 1e.06 s"),
        ("bus.left_leg.loss", "2", "bus.left_leg.loss = 2: expected 0 to 1"),
        ("bus.left_leg.loss", "much", "'much' is not a number"),
        ("firmware.law", "PDQ", "expected one of"),
        ("controller.internal_force.feedback", "yes", "expected true or false"),
    ],
)
def test_wrong_values_are_refused_with_the_key(key: str, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        quantity(SPLIT, key).parse(text)


@pytest.mark.parametrize("key", ["nix", "bus.no_leg.loss", "link.command", "push", "bus.left_leg.node.hip.cut"])
def test_what_is_no_quantity_is_refused(key: str) -> None:
    with pytest.raises(UserError, match=r"no quantity|is not a single value"):
        quantity(SPLIT, key)


def test_every_key_of_a_scenario_written_back_leaves_it_as_it_was() -> None:
    from hil import schema
    from hil.scenario import Scenario

    dump = SPLIT.model_dump(mode="json")
    lists = ("push", "inject", "terrain.blocks", "controller.blocks")  # have no single value
    keys = [k for k in schema.leaves(Scenario, dump) if not k.startswith(lists)]
    assert len(keys) > 100
    values = {key: (q := quantity(SPLIT, key)).written(q.nominal) for key in keys}
    assert changed(SPLIT, values) == SPLIT


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 100))
def test_the_torque_gain_scales_every_gain_of_every_drive(factor: float) -> None:
    scaled = changed(SPLIT, {"joint.torque_gain": factor}).firmware
    for name in ("stance", "swing"):
        for gain in ("kp", "ki", "kd"):
            nominal = getattr(getattr(SPLIT.firmware, name), gain)
            assert getattr(getattr(scaled, name), gain) == pytest.approx(factor * nominal)
    assert changed(SPLIT, {"joint.torque_gain": 1.0}) == SPLIT


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 10))
def test_the_torque_feedback_leaves_the_motor_s_damping(factor: float) -> None:
    nominal, scaled = SPLIT.firmware.swing, changed(SPLIT, {"joint.torque_feedback": factor}).firmware.swing
    assert (scaled.kp, scaled.ki) == pytest.approx((factor * nominal.kp, factor * nominal.ki))
    assert scaled.kd == nominal.kd


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 10))
def test_the_task_bandwidth_moves_the_poles_of_a_task_along_their_rays(factor: float) -> None:
    nominal = SPLIT.controller.tasks
    scaled = changed(SPLIT, {"controller.task_bandwidth": factor}).controller.tasks
    for name in ("com_x", "com_z", "pitch", "roll"):
        poles = [np.roots([1.0, g.kd, g.kp, g.ki]) for g in (getattr(nominal, name), getattr(scaled, name))]
        np.testing.assert_allclose(np.sort_complex(poles[1]), factor * np.sort_complex(poles[0]), rtol=1e-9)


def test_the_task_damping_scales_kd_alone_and_factors_combine() -> None:
    both = changed(SPLIT, {"controller.task_damping": 0.5, "controller.task_bandwidth": 2.0}).controller.tasks.roll
    assert (both.kp, both.kd, both.ki) == pytest.approx((600.0, 20.0, 80.0))


def test_a_mass_error_scales_the_plant_s_weight_and_inertia() -> None:
    import mujoco

    def model(error: float):
        with Experiment(quantity(SPLIT, "world.mass_error").applied(SPLIT, error), seed=0) as experiment:
            return experiment.system.world.model

    light, heavy = model(0.0), model(0.25)
    robot = description.load("hume")
    slider = SPLIT.world.planarizer.slider_mass
    assert mujoco.mj_getTotalmass(heavy) - slider == pytest.approx(1.25 * robot.mass)
    torso = robot.base.name
    assert heavy.body(torso).inertia == pytest.approx(1.25 * light.body(torso).inertia)
