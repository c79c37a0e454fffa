"""How near an ordinary run comes to the limits of its drives' protection."""

from __future__ import annotations

from typing import Any

import numpy as np

from bus.drive_faults import DriveFault
from hil.compiled import compile_function
from hil.run import Assembly, Request, run
from hil.scenario import Scenario


def margins(scenario: Scenario, seed: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The record of a run of ``scenario``, and by joint the largest share of its limit that each fault has used, in the
    order of their numbers from 1 on. 1 would trip, after the time that it may last."""
    peaks: dict[str, np.ndarray] = {}

    def prepare(assembly: Assembly) -> None:
        for drive in assembly.system.joints.nodes:
            peaks[drive.name] = drive.keep_peaks(compile_function)

    outcome = run(Request(scenario, seed, "inline", report=False), prepare=prepare)
    return outcome.record, peaks


def table(peaks: dict[str, np.ndarray]) -> list[tuple[str, ...]]:
    """One row per fault that something measures, one column per joint."""
    rows: list[tuple[str, ...]] = [("share of the limit", *peaks, "largest")]
    for fault in DriveFault:
        if fault in (DriveFault.NONE, DriveFault.WATCHDOG):
            continue
        of = [float(peak[fault - 1]) for peak in peaks.values()]
        rows.append((fault.name.lower().replace("_", " "), *(f"{share:.3f}" for share in of), f"{max(of):.3f}"))
    return rows
