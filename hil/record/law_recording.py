"""What the control law of every drive read and computed in a run, step by step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hil.run import Request, assemble
from hil.scenario import Scenario


class LawRecording(NamedTuple):
    """One drive. A row per step, as the law's function names them: ``counts`` (int32), ``x`` and ``u`` before the step,
    ``y`` and ``x_next`` computed by it; ``p``, one vector that holds for all of them."""

    counts: np.ndarray
    x: np.ndarray
    u: np.ndarray
    y: np.ndarray
    x_next: np.ndarray
    p: np.ndarray


def record_laws(scenario: Scenario, duration: float, seed: int = 0) -> dict[str, LawRecording]:
    """Run the first ``duration`` seconds of ``scenario`` inline. Returns joint → what its drive's law did."""
    rows: dict[str, list[tuple[np.ndarray, ...]]] = {}
    memories: dict[str, Any] = {}

    def wrap(label: str, node: Any) -> Any:
        if label == "firmware":
            for drive in node.nodes:
                memories[drive.name] = drive._law
                rows[drive.name] = []
                drive._evaluate = _noted(drive._law, rows[drive.name])
        return node

    with assemble(Request(scenario, seed=seed, backend="inline"), wrap) as assembly:
        assembly.system.run_until(round(duration * 1e9))
    result = {}
    for name, taken in rows.items():
        counts, x, u, y, x_next = (np.array(column) for column in zip(*taken, strict=True))
        result[name] = LawRecording(counts.astype(np.int32), x, u, y, x_next, memories[name].p_array.copy())
    return result


def _noted(memory: Any, rows: list[tuple[np.ndarray, ...]]) -> Any:
    def evaluate() -> None:
        before = memory.counts_array.copy(), memory.x_array.copy(), memory.u_array.copy()
        memory.evaluate()
        rows.append((*before, memory.y_array.copy(), memory.x_next_array.copy()))

    return evaluate
