"""All the estimators' benches in one result: as text, as JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from central_controller.estimation.foot_models import FootNoise
from central_controller.estimation.orientation_ekf import OrientationNoise
from central_controller.estimation.pendulum_observer import PendulumNoise
from hil.estimator_lab import chain_bench, cost, hume_foot_trial, orientation_trial, pendulum_trial
from hil.estimator_lab.consistency import Consistency
from hil.estimator_lab.foot_trial import Comparison, Score, compare

# The source's errors; the same without occlusions; and filters whose model is right, as a check of the filters.
SETTINGS: dict[str, tuple[chain_bench.Errors, FootNoise, bool]] = {
    "lengths and encoders off as in the source, occlusions": (chain_bench.SOURCE, FootNoise(), True),
    "the same without occlusions": (chain_bench.SOURCE, FootNoise(), False),
    "a true model, occlusions": (chain_bench.NONE, FootNoise(slip=1e-3), True),
}
ORIENTATION = {
    "foot sensors tell when the foot rocks": (True, 0.0),
    "the foot is taken for flat": (False, 0.0),
    f"foot sensors, ground {1e3 * orientation_trial.SLOPE:g} mrad off level": (True, orientation_trial.SLOPE),
}
SHANKS = {
    "rigid shanks": hume_foot_trial.RIGID,
    f"shanks of {hume_foot_trial.TUBE:g} N m/rad": hume_foot_trial.TUBE,
}
FOOT_OFF = 0.05  # m (Kim 2018 §6.2)


@dataclass(frozen=True)
class Results:
    """By setting: of the foot filters on the chain and on Hume, of the orientation filter, of the pendulum observer;
    costs [s] by estimator."""

    seeds: int
    duration: float
    feet: dict[str, Comparison]
    hume_feet: dict[str, list[Score]]
    orientation: dict[str, orientation_trial.Score]
    pendulum: dict[str, pendulum_trial.Errors]
    velocity_off: float  # m/s, of the pendulum observer, when the foot is FOOT_OFF from where it is thought
    costs: dict[str, float]


def measure(seeds: int, duration: float) -> Results:
    """Run all benches, ``seeds`` runs of ``duration`` seconds each."""
    all_seeds, noise = range(seeds), PendulumNoise()
    return Results(
        seeds, duration,
        {name: compare(all_seeds, duration, *setting) for name, setting in SETTINGS.items()},
        {name: hume_foot_trial.compare(all_seeds, duration, stiffness) for name, stiffness in SHANKS.items()},
        {
            name: orientation_trial.score(all_seeds, duration, OrientationNoise(), *setting)
            for name, setting in ORIENTATION.items()
        },
        {
            name: pendulum_trial.observe(pendulum_trial.motion(0, 5 * duration, noise, name), noise)
            for name in pendulum_trial.DISTURBANCES
        },
        pendulum_trial.velocity_off(FOOT_OFF, noise),
        cost.tick_costs(),
    )  # fmt: skip


def as_json(results: Results) -> dict[str, Any]:
    """Everything but the recordings, SI units; nan as None."""
    return {
        "seeds": results.seeds,
        "duration_s": results.duration,
        "foot_position": {name: [_plain(score) for score in c.scores] for name, c in results.feet.items()},
        "foot_position_hume": {name: [_plain(score) for score in scores] for name, scores in results.hume_feet.items()},
        "orientation": {name: _plain(score) for name, score in results.orientation.items()},
        "pendulum": {name: _plain(errors) for name, errors in results.pendulum.items()},
        "pendulum_velocity_off": results.velocity_off,
        "tick_cost_s": results.costs,
        "tick_limit_s": cost.LIMIT,
    }


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def lines(results: Results) -> Iterator[str]:
    """The tables, line by line."""
    yield f"{results.seeds} runs of {results.duration:g} s; NIS and NEES: mean per degree of freedom (1 is right),"
    yield "bounds of an instant's mean over the runs, share of instants within (95 % is right)"
    for name, comparison in results.feet.items():
        yield ""
        yield f"foot position, two-joint chain: {name}"
        head = f"  {'':18} {'error seen':>13} {'occluded':>13} {'NIS':>22} {'NEES':>22} {'NEES of p':>22} {'cost':>6}"
        yield head
        yield f"  {'':18} {'rms / max mm':>13} {'rms / max mm':>13} {'':22} {'':22} {'':22} {'µs':>6}"
        for score in comparison.scores:
            yield "  " + _foot_line(score).rstrip()
    for name, scores in results.hume_feet.items():
        yield ""
        yield f"shank's LED from the torso's, Hume steps: {name}"
        yield f"  {'':18} {'error seen':>13} {'occluded':>13} {'NEES of p':>22}"
        for score in scores:
            seen, hidden = _pair(score.rms_seen, score.max_seen), _pair(score.rms_hidden, score.max_hidden)
            yield f"  {score.name:18} {seen} {hidden} {_consistency(score.foot_nees)}".rstrip()
    yield ""
    yield "orientation, body over a foot that rocks: error rms / max mrad, bias mrad/s, NEES, NIS"
    for name, turn in results.orientation.items():
        yield (
            f"  {name:40} {1e3 * turn.rms:6.2f} / {1e3 * turn.largest:6.2f} {1e3 * turn.bias:6.2f} "
            f"{_consistency(turn.nees)} {_consistency(turn.nis)}"
        )
    yield ""
    yield "pendulum observer, stepping in place: RMS error sensed -> estimated (expected)"
    for name, errors in results.pendulum.items():
        yield (
            f"  {name + ':':12} velocity {100 * errors.sensed_velocity:.2f} -> {100 * errors.velocity:.2f} "
            f"({100 * errors.expected_velocity:.2f}) cm/s, position {1e3 * errors.sensed_position:.2f} -> "
            f"{1e3 * errors.position:.2f} ({1e3 * errors.expected_position:.2f}) mm"
        )
    yield (
        f"  a foot that is {100 * FOOT_OFF:g} cm from where kinematics has it: velocity off by "
        f"{1e3 * abs(results.velocity_off):.1f} mm/s"
    )
    yield ""
    total = sum(results.costs.values())
    yield f"cost of a servo tick: {1e6 * total:.1f} µs of {1e6 * cost.LIMIT:g} µs"
    for name, seconds in results.costs.items():
        yield f"  {name:46} {1e6 * seconds:5.1f} µs"


def _foot_line(score: Score) -> str:
    seen, hidden = (_pair(*pair) for pair in ((score.rms_seen, score.max_seen), (score.rms_hidden, score.max_hidden)))
    consistencies = " ".join(_consistency(c) for c in (score.nis, score.nees, score.foot_nees))
    seconds = "" if score.seconds is None else f"{1e6 * score.seconds:6.1f}"
    return f"{score.name:18} {seen} {hidden} {consistencies} {seconds:>6}"


def _pair(rms: float, largest: float) -> str:
    return f"{'-':>13}" if math.isnan(rms) else f"{1e3 * rms:5.2f} / {1e3 * largest:5.2f}"


def _consistency(c: Consistency | None) -> str:
    if c is None:
        return f"{'':22}"
    return f"{c.ratio:7.3g} {c.low:.2f}-{c.high:.2f} {100 * c.within:3.0f} %"
