"""Runs the trials of a campaign: those that begin alike share one settled system, continued from its snapshot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from hil.analysis.verdict import FallMonitor
from hil.errors import HilError
from hil.injection import configured, injectable
from hil.lab.campaign_file import Campaign, Trial, trials
from hil.lab.running import Running
from hil.lab.workers import parallel
from hil.report.names import file_name
from joint_firmware.drive import DriveState
from robots import description

_SAFE = (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)

Status = Literal["passed", "weak", "failed"]


@dataclass(frozen=True)
class Result:
    """How a row came out with one seed.

    status: as expected; not, and known not to be ("weak"); or not as it should be. sentence: what was seen.
    safe_after: s from the fault to the drive's stop. record: directory of the run, kept unless it passed.
    """

    name: str
    seed: int
    status: Status
    sentence: str
    expectation: str
    weakness: str = ""
    safe_after: float | None = None
    elapsed: float = 0.0
    record: Path | None = None


def run(campaign: Campaign, jobs: int = 1, out: Path | None = None) -> Iterator[Result]:
    """Results of all rows with all seeds, as they come.

    Args:
        jobs: processes.
        out: where runs that did not come out as expected are kept.

    Raises UserError that names the row, before anything has run.
    """
    complete = trials(campaign)
    groups: dict[str, list[Trial]] = {}
    for trial in complete:
        groups.setdefault(f"{trial.at} {trial.scenario.model_dump_json()}", []).append(trial)
    calls = [
        (part, seed, out)
        for seed in campaign.seeds
        for group in groups.values()
        for part in _parts(group, jobs)
    ]
    for results in parallel(_run_group, calls, jobs):
        yield from results


def _parts(group: list[Trial], jobs: int) -> list[list[Trial]]:
    """A group in about ``jobs`` pieces: each settles its own system."""
    return [group[k::jobs] for k in range(min(jobs, len(group)))]


def _run_group(group: Sequence[Trial], seed: int, out: Path | None) -> list[Result]:
    first = group[0]
    with Running(first.scenario, seed) as running:
        running.until(first.at)
        settled = running.snapshot()
        results = []
        for trial in group:
            running.restore(settled)
            results.append(_run(running, trial, out))
        return results


def _run(running: Running, trial: Trial, out: Path | None) -> Result:
    began = time.monotonic()
    row = trial.row
    weakness = row.known_weakness
    result = Result(row.name, running.seed, "failed", "", expectation(trial), weakness)
    if running.stopped is not None:
        return replace(result, sentence=f"failed before the fault: {running.stopped}")
    monitor = running.system.monitor
    try:
        if row.expect == "safe_state":
            running.system.monitor = _falls_only(running)
        good, sentence, safe_after = _observe(running, trial)
    except HilError as error:
        return replace(result, sentence=str(error), elapsed=time.monotonic() - began)
    finally:
        running.system.monitor = monitor
    in_time = trial.joint is None or (safe_after is not None and safe_after <= _within(trial))
    status: Status = "passed" if good else "failed"
    if weakness and good:
        status, sentence = "failed", f"came out as expected, though it is listed as a known weakness: {sentence}"
    elif weakness and in_time:
        status = "weak"
    record = None
    if status != "passed" and out is not None:
        record = out / f"{file_name(row.name)}-seed{running.seed}"
        running.save(record)
    return replace(
        result, status=status, sentence=sentence, safe_after=safe_after, elapsed=time.monotonic() - began, record=record
    )


def _falls_only(running: Running) -> FallMonitor:
    channels = {name: table.names for name, table in running.signals.items()}
    monitor = FallMonitor(running.scenario.limits, channels)
    monitor.restore(running.system.monitor.snapshot())
    return monitor


def _observe(running: Running, trial: Trial) -> tuple[bool, str, float | None]:
    """Whether it comes out as expected, what was seen, and after what time the drive had stopped, s."""
    known = injectable(description.load(trial.scenario.robot))
    for key, value in trial.faults.items():
        running.inject(key, value)
    safe_after = None
    if trial.joint is not None:
        safe_after = _stop(running, trial)
    if trial.until is not None:
        running.until(max(trial.until, running.time))
        for key in trial.faults:
            running.inject(key, known[key].written(configured(trial.scenario, key, known[key].default)))
    running.until(trial.scenario.duration)
    if trial.joint is None:
        outcome = running.outcome()
        return outcome.stable, outcome.reason, None
    fallen = running.stopped
    stood = "it does not fall" if fallen is None else fallen
    if safe_after is None or safe_after > _within(trial):
        when = "does not stop" if safe_after is None else f"stops only after {1e3 * safe_after:.1f} ms"
        return False, f"the drive of {trial.joint} {when}; {stood}", safe_after
    good = fallen is None or trial.row.may_fall
    return good, f"the drive of {trial.joint} stops after {1e3 * safe_after:.1f} ms; {stood}", safe_after


def _stop(running: Running, trial: Trial) -> float | None:
    """Go on, interrupt by interrupt, until the drive has stopped. Returns after what time, s; None: it never does."""
    joints = description.load(trial.scenario.robot).joint_names
    assert trial.joint is not None
    drive: Any = running.system.joints.nodes[joints.index(trial.joint)]
    period, begin = 1.0 / trial.scenario.firmware.rate, running.time
    end = min(trial.until or trial.scenario.duration, trial.scenario.duration)
    while drive.state not in _SAFE:
        if running.time + period > end or running.stopped is not None:
            return None
        running.until(running.time + period)
    return running.time - begin


def _within(trial: Trial) -> float:
    assert trial.row.within is not None  # as is checked of every row that expects a safe state
    return trial.row.within


def expectation(trial: Trial) -> str:
    """What is expected of a row, in words."""
    if trial.joint is None:
        return "stays stable"
    falls = "" if trial.row.may_fall else ", the robot does not fall"
    return f"the drive of {trial.joint} stops within {1e3 * _within(trial):g} ms{falls}"
