"""The trade between torque and position bandwidth, which Kim 2018 §5.1.1 and §7.3.3 claim and do not measure.

Three claims: a lower bandwidth of the torque loops lets that of the position loop rise; feedback of the internal force
makes up for the accuracy that this costs; latency takes the damping that the position loop has to give.

The position loop is looked at by itself, without what else may limit it here: the feedback of the internal force, and
the accelerometer's correction of the attitude, which takes accelerations for tilt. With both, as the scenario has them,
it is looked at once more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.joint_lab.bandwidth import torque_bandwidth
from hil.joint_lab.setup import Setup, Timing
from hil.lab.quantity import changed
from hil.scenario import Scenario
from hil.studies.study import Answers, Claim, Field, Findings, Loops, Part, Runs, Study, Table, Verdict

TORQUE, TASK, DAMPING, FORCE, DELAY = (
    "joint.torque_feedback", "controller.task_bandwidth", "controller.task_damping", "controller.internal_force.gain",
    "link.command.delay",
)  # fmt: skip
ALL_GAINS = "joint.torque_gain"  # with the damping of the motor
ALONE = ("controller.internal_force.feedback=false", "controller.orientation_time_constant=50s")
STIFF = tuple(  # all tasks at twice the bandwidth
    f"controller.tasks.{task}.{gain}={value}"
    for task, kp, kd, ki in (
        ("com_x", 600, 40, 240), ("com_z", 1000, 50, 240), ("pitch", 1000, 50, 240), ("roll", 600, 40, 80),
    )
    for gain, value in (("kp", kp), ("kd", kd), ("ki", ki))
)  # fmt: skip
LATE = "3ms"
_CHANGE = 2.5  # s: the robot stands when its gains change, so that getting up with them is no part of the question
_JOINT = "left_knee"
_MATTERS = 0.05  # a change by less is none
_ERROR, _TRUE, _PLACE = "internal_force_error", "internal_force_error_truth", "com_error_rms"
_OF_RUNS = {  # parts of runs with the position loop alone
    "runs-smooth": "runs without dry friction and noise",
    "runs": "runs with both",
}
_LINES = {  # parts that predict a boundary, with what is to be said of them
    "predicted": "position loop alone",
    "predicted-late": f"position loop alone, {LATE} of delay more",
    "predicted-whole": "all loops, as configured",
}


def parts(quick: bool) -> tuple[Part, ...]:
    """What is run."""
    torques = f"{TORQUE}=0.5,2" if quick else f"{TORQUE}=0.25..4:5:log"
    follow = (TASK, 0.8, 5.0, 0.2)
    alone = Loops("predicted", "stand", ALONE, (torques,), follow=follow)
    tasks = f"{TASK}={'1,4' if quick else '1,1.5,2,2.5,3,3.5,4'}"
    last = f"duration={'5s' if quick else '6s'}"
    runs = Runs("runs", "stand", (*ALONE, last), (torques, tasks), seeds=1 if quick else 2, at=_CHANGE)
    force = Runs(
        "force", "split-terrain", (f"duration={'4s' if quick else '6.5s'}",),
        (torques, f"{FORCE}={'0,3' if quick else '0..3:4'}"), 1 if quick else 2, (_ERROR, _TRUE, _PLACE),
    )  # fmt: skip
    latency = Loops(
        "latency", "stand", (*ALONE, *STIFF),
        (f"{DELAY}={'0ms,6ms' if quick else '0ms..12ms:5'}", f"{DAMPING}={'1,2' if quick else '0.5,0.7,1,1.4,2'}"),
    )  # fmt: skip
    if quick:
        return alone, runs, force, latency
    late = Loops("predicted-late", "stand", (*ALONE, f"{DELAY}={LATE}"), (torques,), follow=follow)
    whole = Loops("predicted-whole", "stand", (), (torques,), follow=follow)
    damping = Loops("predicted-all-gains", "stand", ALONE, (torques.replace(TORQUE, ALL_GAINS),), follow=follow)
    smooth = Runs(
        "runs-smooth",
        "stand",
        (*ALONE, "world.friction_scale=0", "sensors.noise=0", last),
        (torques, tasks),
        at=_CHANGE,
    )
    return alone, late, whole, damping, runs, smooth, force, latency


def torque_bandwidths(scenario: Scenario, factors: Sequence[float], key: str = TORQUE) -> np.ndarray:
    """Of the knee's torque loop, its output held, for each value of ``key``, Hz; NaN of an unstable one."""
    from plant.bench import Locked
    from robots import description

    robot = description.load(scenario.robot)
    joint = robot.joint_names.index(_JOINT)
    found = []
    for factor in factors:
        firmware = changed(scenario, {key: factor}).firmware
        timing = Timing(scenario.controller.rate, firmware.rate)
        setup = Setup(robot, joint, firmware, Locked(), scenario.sensors, timing)
        found.append(torque_bandwidth(setup) or math.nan)
    return np.array(found)


# --- (a) torque against position ------------------------------------------------------------------------------------


def limits(answers: Answers) -> np.ndarray:
    """Largest stable value of a predicted part: infinite where none was found, 0 where the start was not stable; NaN
    where the robot does not stand or the linear loop is not to be trusted."""
    rows = answers.rows
    return np.array([
        math.nan if row["refused"] or row.get("doubt") else row["value"] if row["value"] is not None
        else 0.0 if row["unstable_at_start"] else math.inf
        for row in rows
    ])  # fmt: skip


def largest_stable(answers: Answers) -> np.ndarray:
    """Of runs, (torque, task): the largest task bandwidth up to which half of the runs and more are stable; 0: none."""
    tasks = answers.values(1)
    found = []
    for share in answers.grid("share"):
        good = share >= 0.5
        count = len(good) if good.all() else int(np.argmin(good))
        found.append(tasks[count - 1] if count else 0.0)
    return np.array(found)


def trade(bandwidths: np.ndarray, reached: np.ndarray) -> tuple[Verdict, str]:
    """Whether what is ``reached`` rises as ``bandwidths`` (rising, Hz) fall, and by how much."""
    known = np.isfinite(reached) & (reached > 0.0)
    x, y = bandwidths[known], reached[known]
    if len(x) < 2:
        return "does not hold", "it cannot be told: fewer than two boundaries were found"
    best = int(np.argmax(y))
    gained, lost = y[best] / y[-1] - 1.0, 1.0 - y[0] / y[best]
    rises, falls = gained > _MATTERS, lost > _MATTERS
    course = ", ".join(f"×{b:.2f} at {a:.0f} Hz" for a, b in zip(x[::-1], y[::-1], strict=True))
    nowhere = ", ".join(f"{a:.0f} Hz" for a in bandwidths[reached == 0.0][::-1])
    course += f" (none at {nowhere})" if nowhere else ""
    unknown = ", ".join(f"{a:.0f} Hz" for a in bandwidths[np.isnan(reached)][::-1])
    course += f" (not known at {unknown})" if unknown else ""
    if rises and not falls:
        return "holds", f"{course}: it rises by {100 * gained:.0f} % as the torque bandwidth falls"
    if rises:
        told = f"it rises by {100 * gained:.0f} % down to a torque bandwidth of {x[best]:.0f} Hz"
        return "holds in part", f"{course}: {told}, and falls by {100 * lost:.0f} % from there on"
    if falls:
        return "does not hold", f"{course}: it falls by {100 * lost:.0f} % as the torque bandwidth falls"
    return "does not hold", f"{course}: it does not change by more than {100 * _MATTERS:.0f} %"


def _shown(limit: float, far: str = "beyond the search") -> str:
    if math.isnan(limit):
        return "–"
    return far if math.isinf(limit) else "none" if limit == 0.0 else f"×{limit:.2f}"


def _torque_against_position(found: Mapping[str, Answers]) -> Findings:
    runs = found["runs"]
    factors = runs.values(0)
    hertz = torque_bandwidths(runs.scenario, factors.tolist())
    lines = {name: limits(found[name]) for name in _LINES if name in found}
    of_runs = {text: largest_stable(found[name]) for name, text in _OF_RUNS.items() if name in found}
    of_task = math.sqrt(runs.scenario.controller.tasks.com_x.kp) / (2.0 * math.pi)
    rows = []
    for n, factor in enumerate(factors):
        predicted = [text for name, line in lines.items() for text in (_shown(line[n]), _by(found[name].rows[n]))]
        rows.append((f"×{factor:g}", f"{hertz[n]:.1f} Hz", *predicted, *(_shown(line[n]) for line in of_runs.values())))
    heads = [text for name in lines for text in (f"predicted, {_LINES[name]}", "by")]
    table = Table(
        f"Largest stable bandwidth of the tasks (×1: natural frequency of CoM x {of_task:.2f} Hz)",
        (TORQUE, f"torque bandwidth, {_JOINT}", *heads, *of_runs), tuple(rows),
    )  # fmt: skip
    tables = (table, *_all_gains(found))
    told = [(*trade(hertz, line), f"Predicted, {_LINES[name]}") for name, line in lines.items()]
    whole = [np.isfinite(line).all() for line in lines.values()]  # what is not known in part cannot tell
    claim = Claim(
        "A lower bandwidth of the torque loops lets the bandwidth of the position loop rise.",
        told[whole.index(True) if any(whole) else 0][0],
        (*(f"{who}: {numbers}." for _, numbers, who in told),
         *(f"{text[0].upper()}{text[1:]}: {trade(hertz, line)[1]}." for text, line in of_runs.items())),
    )  # fmt: skip
    tasks = runs.values(1)
    share = runs.grid("share")
    curves = {
        f"predicted, {_LINES[name]}": (factors, np.where(line > 0.0, line, np.nan)) for name, line in lines.items()
    }
    field = Field(
        "torque-position", "Torque loop against position loop",
        "Colours: share of stable runs with dry friction, position loop alone. Lines: where the linear loop, which has "
        "no dry friction, becomes unstable. " + _hertz_told(factors, hertz),
        f"{TORQUE} (gain of the torque loops)", TASK, "share of stable runs", factors, tasks, share.T,
        tuple(tuple(f"{100 * value:.0f} %" for value in row) for row in share.T), (0.0, 1.0), "RdYlBu", (True, True),
        curves,
    )  # fmt: skip
    return Findings((claim,), tables, (field,))


def _all_gains(found: Mapping[str, Answers]) -> tuple[Table, ...]:
    if "predicted-all-gains" not in found:
        return ()
    answers = found["predicted-all-gains"]
    factors = answers.values(0)
    hertz = torque_bandwidths(answers.scenario, factors.tolist(), ALL_GAINS)
    rows = tuple(
        (f"×{factor:g}", f"{hertz[n]:.1f} Hz", _shown(limit), _by(answers.rows[n]))
        for n, (factor, limit) in enumerate(zip(factors, limits(answers), strict=True))
    )
    head = (ALL_GAINS, f"torque bandwidth, {_JOINT}", f"predicted, {_LINES['predicted']}", "by")
    return (Table("The same, when the damping of the motor is scaled with the feedback of the torque", head, rows),)


def _damped(row: Mapping[str, Any]) -> str:
    return f"{row['damping']:.3f}{'' if row.get('doubt') is None else ' (not to be trusted)'}"


def _by(row: Mapping[str, object]) -> str:
    if row["refused"] or row.get("doubt"):
        return str(row["refused"] or row.get("doubt"))
    if row.get("mode") is None:
        return "–"
    return f"{row['frequency']:.1f} Hz: {row['mode']}"


def _hertz_told(factors: np.ndarray, hertz: np.ndarray) -> str:
    pairs = ", ".join(f"×{f:g} {h:.0f} Hz" for f, h in zip(factors, hertz, strict=True))
    return f"Bandwidth of the {_JOINT.replace('_', ' ')}'s torque loop: {pairs}."


# --- (b) accuracy of the internal force -----------------------------------------------------------------------------


def _accuracy(found: Mapping[str, Answers]) -> Findings:
    answers = found["force"]
    factors, gains = answers.values(0), answers.values(1)
    hertz = torque_bandwidths(answers.scenario, factors.tolist())
    error, sensed, place, share = (answers.grid(name) for name in (_TRUE, _ERROR, _PLACE, "share"))
    own = int(np.argmin(np.abs(gains - answers.scenario.controller.internal_force.gain)))
    rows = tuple(
        (f"×{factor:g}", f"{hertz[n]:.1f} Hz", f"{gain:g}", _number(100 * error[n, m], 1, "%"),
         _number(100 * sensed[n, m], 1, "%"), _number(1e3 * place[n, m], 2, "mm"),
         answers.rows[n * len(gains) + m]["ends"])
        for n, factor in enumerate(factors) for m, gain in enumerate(gains)
    )  # fmt: skip
    table = Table(
        "Error of the internal force, mean of its size over the reference",
        (TORQUE, f"torque bandwidth, {_JOINT}", "K_F", "true", "sensed", "CoM error, rms", "ends"), rows,
    )  # fmt: skip
    verdict, numbers = make_up(hertz, error[:, 0], error[:, own], gains[own])
    of_sensed = make_up(hertz, sensed[:, 0], sensed[:, own], gains[own])[1]
    numbers += tuple(number.replace("off by", "off by, as sensed,") for number in of_sensed)
    middle = int(np.argmin(np.abs(np.log(factors))))
    claim = Claim(
        "Detuned torque loops cost accuracy of the internal force, and its feedback makes up for that.",
        verdict,
        (*numbers, f"Position does not pay for it: CoM error {1e3 * place[middle, 0]:.2f} mm rms without, "
                   f"{1e3 * place[middle, own]:.2f} mm with feedback (gain ×{factors[middle]:g})."
         if place[middle, own] <= (1 + _MATTERS) * place[middle, 0] else
         f"Position pays for it: CoM error {1e3 * place[middle, 0]:.2f} mm rms without, "
         f"{1e3 * place[middle, own]:.2f} mm with feedback (gain ×{factors[middle]:g})."),
    )  # fmt: skip
    text = tuple(
        tuple(
            f"{100 * error[n, m]:.1f} %" + ("" if share[n, m] == 1.0 else f"\n{100 * (1.0 - share[n, m]):.0f} % fail")
            for n in range(len(factors))
        )
        for m in range(len(gains))
    )
    field = Field(
        "internal-force", "Error of the internal force on split terrain",
        "True force, mean size of the error over the reference of 100 N, from settling to the end or to the failure of "
        "the run. " + _hertz_told(factors, hertz),
        f"{TORQUE} (gain of the torque loops)", "K_F", "error / reference", factors, gains, error.T, text,
        (0.0, max(0.2, float(np.nanmax(error)))), "YlOrRd", (True, False),
    )  # fmt: skip
    return Findings((claim,), (table,), (field,))


def _number(value: float, digits: int, unit: str) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f} {unit}"


def make_up(
    hertz: np.ndarray, without: np.ndarray, with_it: np.ndarray, gain: float
) -> tuple[Verdict, tuple[str, ...]]:
    """Whether the errors ``without`` feedback grow as the bandwidths ``hertz`` (rising) fall, and whether those with
    feedback stay below the best of them."""
    costs = without[0] > (1.0 + _MATTERS) * without[-1]
    makes_up = with_it[0] < without[-1]
    first = (
        f"Without feedback the force is off by {100 * without[-1]:.1f} % at {hertz[-1]:.0f} Hz of torque bandwidth and "
        f"by {100 * without[0]:.1f} % at {hertz[0]:.0f} Hz: detuning {'costs' if costs else 'does not cost'} accuracy."
    )
    second = (
        f"With K_F = {gain:g} it is off by {100 * with_it[-1]:.1f} % and {100 * with_it[0]:.1f} %: of the slowest "
        f"loop's error feedback takes {100 * (1 - with_it[0] / without[0]):.0f} %, which makes it "
        f"{'better' if makes_up else 'no better'} than the fastest without."
    )
    verdict: Verdict = "holds" if costs and makes_up else "holds in part" if costs or makes_up else "does not hold"
    return verdict, (first, second)


# --- (c) latency and damping ----------------------------------------------------------------------------------------


def zero_crossing(x: np.ndarray, y: np.ndarray) -> float:
    """Where ``y`` first falls below 0 along ``x``, by straight lines; infinite if it does not, ``x[0]`` if it starts
    there."""
    below = np.flatnonzero(y < 0.0)
    if not len(below):
        return math.inf
    n = int(below[0])
    if n == 0:
        return float(x[0])
    return float(x[n - 1] + (x[n] - x[n - 1]) * y[n - 1] / (y[n - 1] - y[n]))


def _latency(found: Mapping[str, Answers]) -> Findings:
    answers = found["latency"]
    delays, gains = 1e3 * answers.values(0), answers.values(1)
    damping = answers.grid("damping")
    ends = [zero_crossing(delays, column) for column in damping.T]
    rows = tuple(
        (f"×{gain:g}", *(_damped(answers.rows[n * len(gains) + m]) for n in range(len(delays))),
         f"beyond {delays[-1]:g} ms" if math.isinf(ends[m]) else f"{ends[m]:.1f} ms",
         *(_by(answers.rows[n * len(gains) + m]) for n in (0, len(delays) - 1)))
        for m, gain in enumerate(gains)
    )  # fmt: skip
    table = Table(
        "Damping ratio of the least damped oscillation of the linear loop",
        (DAMPING, *(f"{d:g} ms" for d in delays), "undamped at", f"at {delays[0]:g} ms", f"at {delays[-1]:g} ms"), rows,
    )  # fmt: skip
    falls = bool((damping[-1] < damping[0]).all())
    own = int(np.argmin(np.abs(np.log(gains))))
    spent = (damping[0, own] - damping[-1, own]) / (delays[-1] - delays[0])
    best = [int(np.argmax(row)) for row in damping]
    numbers = (
        f"At the scenario's own damping gains {delays[-1]:g} ms of command delay take the damping ratio from "
        f"{damping[0, own]:.3f} to {damping[-1, own]:.3f}, {spent:.3f} per millisecond.",
        f"The best of the damping gains tried is ×{gains[best[0]]:g} without delay (damping ratio "
        f"{damping[0, best[0]]:.3f}) and ×{gains[best[-1]]:g} at {delays[-1]:g} ms ({damping[-1, best[-1]]:.3f}).",
        "Delay at which nothing is damped any more: "
        + ", ".join(f"{row[len(delays) + 1]} with {row[0]}" for row in rows) + ".",
    )  # fmt: skip
    claim = Claim("Latency takes the damping.", "holds" if falls else "does not hold", numbers)
    reach = max(0.1, float(np.nanmax(np.abs(damping))))
    field = Field(
        "latency-damping", "Latency against damping gain",
        "Damping ratio of the least damped oscillation above 0.5 Hz, position loop alone, linear loop without dry "
        "friction. Line: undamped.",
        f"{DELAY} [ms]", f"{DAMPING} (gain)", "damping ratio", delays, gains, damping.T,
        tuple(tuple(f"{value:.3f}" for value in row) for row in damping.T), (-reach, reach), "RdYlBu", (False, True),
        zero=True,
    )  # fmt: skip
    return Findings((claim,), (table,), (field,))


def conclude(found: Mapping[str, Answers]) -> Findings:
    """Claims, tables and maps, in the order of the claims."""
    each = [of(found) for of in (_torque_against_position, _accuracy, _latency)]
    claims, tables, fields = (
        [item for findings in each for item in getattr(findings, name)] for name in ("claims", "tables", "fields")
    )
    return Findings(tuple(claims), tuple(tables), tuple(fields))


STUDY = Study(
    "bandwidth", "Torque bandwidth against position bandwidth",
    "what detuned torque loops, feedback of the internal force, and latency do (Kim 2018 §5.1.1, §7.3.3)",
    parts, conclude,
)  # fmt: skip
