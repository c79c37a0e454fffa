"""The light foot filter on Hume that steps: what it is fed with, and what it is worth."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from central_controller.model import RobotModel
from hil.errors import EmulationError
from hil.estimator_lab import hume_foot_trial as trial
from robots import description

ROBOT = description.load("hume")


def test_the_jacobian_is_the_derivative_of_the_place() -> None:
    model, leds = RobotModel(ROBOT), {led.name: led for led in ROBOT.motion_capture.leds}
    torso = [led for led in leds.values() if led.link == ROBOT.base.name]
    rng, d = np.random.default_rng(4), 1e-6
    q = pin.integrate(model.model, pin.neutral(model.model), rng.uniform(-0.5, 0.5, model.nv))

    def place(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places, jacobians = trial._seen_from_torso(model, ROBOT, leds["left_foot"], torso, [(0, q)])
        return places[0], jacobians[0]

    for k, unit in enumerate(np.eye(model.nv)):
        ends = [place(pin.integrate(model.model, q, sign * d * unit))[0] for sign in (1, -1)]
        np.testing.assert_allclose(place(q)[1][:, k], (ends[0] - ends[1]) / (2 * d), atol=1e-8)
    np.testing.assert_allclose(place(q)[1][:, :3], 0.0, atol=1e-12)  # where the base is does not matter


@pytest.fixture(scope="module")
def feet() -> list[trial.Recording]:
    return trial.record(0, 1.5, trial.TUBE)


def test_frames_are_what_the_cameras_saw(feet: list[trial.Recording]) -> None:
    assert len(feet) == 2
    for foot in feet:
        for frames, late in ((foot.exposed, 0.0), (foot.arrived, 5e-3)):
            new = ~np.isnan(frames[:, 0])
            assert new[~foot.hidden].mean() == pytest.approx(480 / 1500, abs=0.03)
            was = np.roll(foot.truth, round(late * foot.rate), axis=0)
            error = np.linalg.norm(frames - was, axis=1)[new][10:]  # rolled in at the start
            assert np.median(error) < 3e-3  # noise and placement of both ends, and up to a tick of motion
        assert not (~np.isnan(foot.exposed[:, 0]) & foot.hidden).any()
        assert foot.hidden.mean() == pytest.approx(0.4, abs=0.15)
        swings = np.linalg.norm(np.gradient(foot.truth, axis=0), axis=1) * foot.rate > 0.5  # m/s
        told = np.einsum("nij,nj->ni", foot.jacobian, foot.v)[swings]
        true = np.gradient(foot.truth, axis=0)[swings] * foot.rate
        assert np.corrcoef(told.ravel(), true.ravel())[0, 1] > 0.98


def test_the_filter_is_better_than_kinematics_while_it_sees(monkeypatch: pytest.MonkeyPatch, feet: list) -> None:
    monkeypatch.setattr(trial, "record", lambda *_: feet)
    kinematics, exposed, late = trial.compare([0], 1.5, trial.TUBE)
    assert exposed.rms_seen < 0.7 * kinematics.rms_seen
    assert exposed.rms_seen < late.rms_seen
    assert exposed.rms_hidden > exposed.rms_seen
    assert exposed.foot_nees is not None and exposed.foot_nees.ratio < 1.5  # it is not surer than it may be


def test_a_robot_that_falls_is_told() -> None:
    with pytest.raises(EmulationError, match=r"balance with seed 0 and shanks of 560 N m/rad: drive in fault"):
        trial.record(0, 1.0, 560.0)
