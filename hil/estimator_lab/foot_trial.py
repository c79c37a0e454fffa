"""The four foot filters of Kim 2018 §6.2 on the same recordings of the two-joint chain."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from central_controller.estimation.foot_models import FootFilter, FootNoise
from central_controller.estimation.foot_position import FILTERS
from hil.compiled import compile_function
from hil.estimator_lab.chain_bench import RATE, Errors, Recording, model, record
from hil.estimator_lab.consistency import Consistency, consistency, normalised

SETTLED = 0.5  # s: what was before does not count
_NEES_EVERY = 10  # samples


@dataclass(frozen=True)
class Run:
    """One filter on one recording."""

    estimate: np.ndarray  # (samples, 2) m
    nis: np.ndarray  # (samples,)
    measurements: np.ndarray  # (samples,) how many there were: degrees of freedom of the NIS
    nees: np.ndarray  # (instants,) of the whole state
    foot_nees: np.ndarray  # (instants,) of the foot's position
    fields: int  # of the state: degrees of freedom of the NEES
    seconds: float  # the median of an update's computing time, with its prediction


@dataclass(frozen=True)
class Score:
    """Errors of the foot's position [m] over all runs, while motion capture sees it and while not (nan: never), and
    whether the filter knows how large they are."""

    name: str
    rms_seen: float
    max_seen: float
    rms_hidden: float
    max_hidden: float
    nis: Consistency | None = None
    nees: Consistency | None = None
    foot_nees: Consistency | None = None
    seconds: float | None = None


def run(filter: FootFilter, recording: Recording) -> Run:
    """Run ``filter`` over ``recording``, from its first encoders."""
    ticks, dt = len(recording.seconds), 1.0 / RATE
    estimate, nis, measurements = np.zeros((ticks, 2)), np.zeros(ticks), np.zeros(ticks)
    nees, foot_nees, times = [], [], np.zeros(ticks, int)
    new = ~np.isnan(recording.mocap[:, 0])
    filter.start(recording.encoders[0])
    clock = time.perf_counter_ns
    # the light filter does not observe joint angles
    joints = recording.encoders.shape[1] if "q" in filter.fields else recording.q.shape[1]
    for k in range(ticks):
        encoders, mocap = recording.encoders[k], recording.mocap[k] if new[k] else None
        began = clock()
        filter.predict(dt, recording.torque[k])
        filter.update(encoders, mocap)
        times[k] = clock() - began
        estimate[k], nis[k] = filter.position, filter.nis
        measurements[k] = joints + 2 * new[k]
        if k % _NEES_EVERY == 0:
            truth = np.concatenate([getattr(recording, field)[k] for field in filter.fields])
            nees.append(normalised(filter.state - truth, filter.covariance))
            foot_nees.append(normalised(estimate[k] - recording.p[k], filter.position_covariance))
    return Run(
        estimate, nis, measurements, np.array(nees), np.array(foot_nees), len(filter.state),
        float(np.median(times)) * 1e-9,
    )  # fmt: skip


def _errors(name: str, estimates: Sequence[np.ndarray], recordings: Sequence[Recording]) -> Score:
    settled = round(SETTLED * RATE)
    distances = [np.linalg.norm(e - r.p, axis=1)[settled:] for e, r in zip(estimates, recordings, strict=True)]
    hidden = [r.hidden[settled:] for r in recordings]
    distance, unseen = np.concatenate(distances), np.concatenate(hidden)
    return Score(name, *rms_and_max(distance[~unseen]), *rms_and_max(distance[unseen]))


def rms_and_max(distances: np.ndarray) -> tuple[float, float]:
    """nan of none."""
    if not len(distances):
        return math.nan, math.nan
    return float(np.sqrt(np.mean(distances**2))), float(distances.max())


def _score(name: str, runs: Sequence[Run], recordings: Sequence[Recording]) -> Score:
    settled = round(SETTLED * RATE)
    errors = _errors(name, [run.estimate for run in runs], recordings)
    nis, freedoms = (np.array([getattr(run, what)[settled:] for run in runs]) for what in ("nis", "measurements"))
    first = settled // _NEES_EVERY
    nees, foot = (np.array([getattr(run, what)[first:] for run in runs]) for what in ("nees", "foot_nees"))
    return Score(
        name, errors.rms_seen, errors.max_seen, errors.rms_hidden, errors.max_hidden,
        consistency(nis, freedoms), consistency(nees, np.full_like(nees, runs[0].fields)),
        consistency(foot, np.full_like(foot, 2.0)), float(np.median([run.seconds for run in runs])),
    )  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """All filters on the same recordings. ``kinematics``: the foot (samples, 2) [m] where the encoders put it; ``runs``
    by filter: both in the recordings' order."""

    scores: list[Score]
    recordings: list[Recording]
    kinematics: list[np.ndarray]
    runs: dict[str, list[Run]]


def compare(seeds: Sequence[int], duration: float, errors: Errors, noise: FootNoise, occluded: bool) -> Comparison:
    """Score kinematics alone, and each filter, over a recording per seed."""
    chain = model(errors)
    recordings = [record(seed, duration, errors, noise, occluded) for seed in seeds]
    kinematics = [np.array([chain.forward(q) for q in r.encoders[:, :2]]) for r in recordings]
    scores, runs = [_errors("kinematics alone", kinematics, recordings)], {}
    for name, make in FILTERS.items():
        filter = make(chain, noise, compile_function)
        runs[name] = [run(filter, recording) for recording in recordings]
        scores.append(_score(name, runs[name], recordings))
    return Comparison(scores, recordings, kinematics, runs)
