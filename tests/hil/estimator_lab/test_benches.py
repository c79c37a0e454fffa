"""What the estimators do on their benches, and what the command says of it."""

from __future__ import annotations

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from central_controller.estimation.chain import Chain
from central_controller.estimation.foot_extended import ConfigurationFilter
from central_controller.estimation.foot_models import FootNoise, accelerated
from central_controller.estimation.foot_position import FILTERS
from central_controller.estimation.kalman import ExtendedKalmanFilter
from central_controller.estimation.orientation_ekf import OrientationNoise
from hil.cli import main
from hil.estimator_lab import chain_bench, orientation_trial
from hil.estimator_lab.consistency import consistency
from hil.estimator_lab.foot_trial import run


def test_the_chain_moves_as_its_energy_says() -> None:
    """Work of the torques is the gain of energy: pinocchio's motion, by the filters' own Lagrangian."""
    recording = chain_bench.record(0, 1.0, chain_bench.NONE, FootNoise(acceleration=0.0))
    chain = chain_bench.model(chain_bench.NONE)
    kinetic = ca.Function("kinetic", [chain.q, chain.dq], [chain.dq.T @ chain.mass_matrix @ chain.dq / 2])

    def energy(k: int) -> float:
        q, dq = recording.q[k], recording.dq[k]
        heights = [0.15 * np.sin(q[0]), 0.3 * np.sin(q[0]) + 0.15 * np.sin(q.sum())]
        return float(kinetic(q, dq)) + 9.81 * sum(heights)

    power = np.sum(recording.torque[1:] * np.diff(recording.q, axis=0), axis=1)
    assert energy(len(recording.q) - 1) - energy(0) == pytest.approx(np.sum(power), abs=1e-4)


def test_sensors_are_off_as_stated() -> None:
    recording = chain_bench.record(0, 4.0, chain_bench.SOURCE, FootNoise())
    off = recording.encoders - np.hstack([recording.q, recording.dq])
    np.testing.assert_allclose(off.mean(axis=0), [0.03, -0.05, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(off.std(axis=0), [0.002, 0.002, 0.02, 0.02], rtol=0.05)
    new = ~np.isnan(recording.mocap[:, 0])
    assert not (new & recording.hidden).any()
    assert 0 < recording.hidden.mean() < 1
    assert new[~recording.hidden].mean() == pytest.approx(480 / 1500, abs=0.01)
    np.testing.assert_allclose((recording.mocap - recording.p)[new].std(axis=0), 1e-3, rtol=0.1)
    lengths = chain_bench.model(chain_bench.SOURCE).forward(np.zeros(2))
    np.testing.assert_allclose(lengths, [0.31 + 0.28, 0.0])


def test_with_a_true_model_the_configuration_filter_knows_its_error() -> None:
    noise = FootNoise()
    recordings = [chain_bench.record(seed, 2.0, chain_bench.NONE, noise) for seed in range(4)]
    filter = FILTERS["EKF, configuration"](chain_bench.model(chain_bench.NONE), noise)
    runs = [run(filter, recording) for recording in recordings]
    nees = np.array([r.nees[50:] for r in runs])
    found = consistency(nees, np.full_like(nees, 4.0))
    assert found.ratio == pytest.approx(1.0, abs=0.25)
    assert found.within > 0.85
    nis, freedoms = (np.array([getattr(r, what)[750:] for r in runs]) for what in ("nis", "measurements"))
    found = consistency(nis, freedoms)
    assert found.ratio == pytest.approx(1.0, abs=0.05)
    assert found.within == pytest.approx(0.95, abs=0.02)


class Printed(ConfigurationFilter):
    """With Euler's step, as (6.27) prints it."""

    def __init__(self, chain: Chain, noise: FootNoise) -> None:
        super().__init__(chain, noise)
        dt, x = ca.SX.sym("dt"), ca.vertcat(chain.q, chain.dq)
        f = ca.vertcat(chain.q + chain.dq * dt, chain.dq + chain.acceleration * dt)
        Q, h = accelerated(noise.acceleration, 2, dt, ca.SX(4, 4)), ca.vertcat(x, chain.position)
        self._ekf = ExtendedKalmanFilter("printed", x, chain.torque, dt, f, h, Q)
        self.state, self.covariance = self._ekf.state, self._ekf.covariance


def test_the_step_as_printed_is_too_sure_of_itself() -> None:
    noise, chain = FootNoise(), chain_bench.model(chain_bench.NONE)
    recordings = [chain_bench.record(seed, 2.0, chain_bench.NONE, noise) for seed in range(2)]
    ratios = [
        np.mean([run(filter, recording).nees[50:] for recording in recordings]) / 4
        for filter in (Printed(chain, noise), ConfigurationFilter(chain, noise))
    ]
    assert ratios[0] > 2.0 > 1.5 > ratios[1]


def test_foot_sensors_keep_a_rocking_foot_from_turning_the_body() -> None:
    told, untold = (orientation_trial.score(range(2), 5.0, OrientationNoise(), sensors) for sensors in (True, False))
    assert told.rms < 2e-3
    assert told.bias < 2e-3  # of 20 mrad/s
    assert untold.rms > 10 * told.rms
    assert told.nees.ratio < 1.9 < untold.nees.ratio  # sure enough, but not too sure


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new"
    assert main(["estimators", "--seeds", "1", "--duration", "2s", "--json", "--out", str(out)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert json.loads((out / "estimators.json").read_text()) == result
    assert len(list(out.glob("foot-position-*.png"))) == 3
    for scores in result["foot_position"].values():
        assert [score["name"] for score in scores] == ["kinematics alone", *FILTERS]
    kinematics, *filters = next(iter(result["foot_position"].values()))
    assert kinematics["rms_seen"] > 8e-3
    assert all(score["rms_seen"] < 2e-3 for score in filters if "configuration" not in score["name"])
    assert filters[0]["nees"]["ratio"] > 100  # biased encoders, and the filter does not know
    for errors in result["pendulum"].values():
        assert errors["velocity"] < errors["sensed_velocity"] / 3
    assert sum(result["tick_cost_s"].values()) < result["tick_limit_s"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--seeds", "0"], "--seeds 0: expected at least 1"),
        (["--duration", "1s"], "--duration 1s: expected 2s to 60s"),
    ],
)
def test_what_is_refused(arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["estimators", *arguments]) == 2
    assert sentence in capsys.readouterr().err
