"""What the control law of every drive read and computed in a run, step by step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hil.run import Request, assemble
from hil.scenario import Scenario


class LawRecording(NamedTuple):
    """One drive, from where it knows its position.

    A row per step, as the law's function names them: ``counts`` (int32), ``x`` and ``u`` before the step, ``y`` and
    ``x_next`` computed by it; ``p``, one vector that holds for all of them, and ``p_at_power_on``, what it was before
    the drive found its encoder's zero.
    """

    counts: np.ndarray
    x: np.ndarray
    u: np.ndarray
    y: np.ndarray
    x_next: np.ndarray
    p: np.ndarray
    p_at_power_on: np.ndarray


def record_laws(scenario: Scenario, duration: float, seed: int = 0) -> dict[str, LawRecording]:
    """Run ``scenario`` inline until ``duration`` s after its drives' boot. Returns joint → what its drive's law did in
    the first ``duration`` s in which its parameters were what they are in the end."""
    rows: dict[str, list[tuple[np.ndarray, ...]]] = {}
    memories: dict[str, Any] = {}
    at_power_on: dict[str, np.ndarray] = {}

    def wrap(label: str, node: Any) -> Any:
        if label == "firmware":
            for drive in node.nodes:
                memories[drive.name] = drive._law
                at_power_on[drive.name] = drive._law.p_array.copy()
                rows[drive.name] = []
                drive._evaluate = _noted(drive._law, rows[drive.name])
        return node

    with assemble(Request(scenario, seed=seed, backend="inline"), wrap) as assembly:
        assembly.system.run_until(round((duration + scenario.firmware.boot_time) * 1e9))
    steps, result = round(duration * scenario.firmware.rate), {}
    for name, taken in rows.items():
        counts, x, u, y, x_next = (np.array(column) for column in zip(*taken[:steps], strict=True))
        p = memories[name].p_array.copy()
        result[name] = LawRecording(counts.astype(np.int32), x, u, y, x_next, p, at_power_on[name])
    return result


def _noted(memory: Any, rows: list[tuple[np.ndarray, ...]]) -> Any:
    p = memory.p_array.copy()

    def evaluate() -> None:
        if (p != memory.p_array).any():
            p[:] = memory.p_array
            rows.clear()
        before = memory.counts_array.copy(), memory.x_array.copy(), memory.u_array.copy()
        memory.evaluate()
        rows.append((*before, memory.y_array.copy(), memory.x_next_array.copy()))

    return evaluate


def parameter_lines(recording: LawRecording) -> list[str]:
    """What the drive found out at power-on, as an export's example reads it."""
    changed = np.flatnonzero(recording.p != recording.p_at_power_on)
    return [f"p {index} {float(recording.p[index])!r}" for index in changed]
