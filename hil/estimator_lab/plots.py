"""The foot filters over time, as Kim 2018 Figs. 6.2–6.4 show them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hil.estimator_lab.chain_bench import MOCAP_RATE, Recording
from hil.estimator_lab.foot_trial import Comparison

_SPAN = 3.0  # s that are shown
_STYLES: dict[str, dict[str, Any]] = {  # these three lie on one another
    "EKF, end effector": {"linewidth": 2.2, "alpha": 0.6},
    "UKF, end effector": {"linewidth": 1.0, "dashes": (5, 3)},
    "light (Hume)": {"linewidth": 1.0, "dashes": (1, 3), "color": "k"},
}


def _occlusions(recording: Recording) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], recording.hidden.astype(int), [0]])))
    seconds = np.append(recording.seconds, recording.seconds[-1])
    return [(float(seconds[a]), float(seconds[b])) for a, b in edges.reshape(-1, 2)]


def foot_position(comparison: Comparison, title: str, path: Path) -> None:
    """End effector in x and y, and the error's size, of the first recording; occlusions are shaded."""
    recording = comparison.recordings[0]
    shown = recording.seconds <= min(_SPAN, recording.seconds[-1])
    t = recording.seconds[shown]
    figure, axes = plt.subplots(3, 1, figsize=(8.0, 8.0), sharex=True, layout="constrained")
    for axis in axes:
        for start, end in _occlusions(recording):
            axis.axvspan(start, end, color="0.9", linewidth=0)
        axis.grid(alpha=0.3)
    runs = {name: runs[0].estimate for name, runs in comparison.runs.items()}
    for i, axis in enumerate(axes[:2]):
        axis.plot(t, 1e3 * recording.p[shown, i], color="k", linewidth=2.0, label="true")
        axis.plot(
            t, 1e3 * recording.mocap[shown, i], ".", color="gold", markersize=3,
            label=f"motion capture, {MOCAP_RATE:g} Hz",
        )  # fmt: skip
        axis.set_ylabel(f"$p_{'xy'[i]}$ [mm]")
    for name, estimate in {"kinematics alone": comparison.kinematics[0], **runs}.items():
        style = _STYLES.get(name, {"linewidth": 0.9})
        for i, axis in enumerate(axes[:2]):
            axis.plot(t, 1e3 * estimate[shown, i], label=name, **style)
        axes[2].plot(t, 1e3 * np.linalg.norm(estimate - recording.p, axis=1)[shown], label=name, **style)
    axes[2].set(xlabel="time [s]", ylabel="error [mm]", xlim=(0.0, float(t[-1])), ylim=(0.0, None))
    axes[0].legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.suptitle(f"{title} (shaded: occluded)", fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)
