"""The numbers of a run that a person is shown: names, units, limits, in one order for all pages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Number:
    """value, limit: SI; shown is ``scale`` times that, in ``unit``. A value of None has no meaning in the run."""

    name: str
    value: float | None
    scale: float = 1.0
    unit: str = ""
    limit: float | None = None
    note: str = ""

    @property
    def shown(self) -> str:
        return "–" if self.value is None else f"{self.value * self.scale:.4g}"

    @property
    def bound(self) -> str:
        """The limit, or else what is to be said about the number."""
        if self.limit is None:
            return self.note
        return f"limit {self.limit * self.scale:.4g}{' ' + self.unit if self.unit else ''}"

    @property
    def beyond(self) -> bool:
        return self.limit is not None and self.value is not None and self.value > self.limit


def key_numbers(metrics: Mapping[str, Any], configuration: Mapping[str, Any]) -> list[Number]:
    """Those of a run with these ``metrics`` (of run.json) and this ``configuration`` (a scenario's ``model_dump``)."""
    limits = configuration["limits"]
    period = 1e3 / configuration["controller"]["rate"]
    force = "% of the reference"
    found = [
        Number("CoM error, largest", metrics.get("com_error_max"), 1e3, "mm", limits["com_error"]),
        Number("CoM error, rms", metrics.get("com_error_rms"), 1e3, "mm"),
        Number(
            "torso's tilt, largest", metrics.get("orientation_error_max"), 180.0 / math.pi, "°",
            limits["orientation_error"],
        ),
        Number("internal force, error of the sensed", metrics.get("internal_force_error"), 100, force),
        Number("internal force, error of the true", metrics.get("internal_force_error_truth"), 100, force),
        Number("internal force, sensed against true", metrics.get("internal_force_sensed_vs_truth"), 100, force),
        Number("foot slip, largest", metrics.get("foot_slip_max"), 1e3, "mm", limits["foot_slip"]),
        Number("foot without load, longest", metrics.get("contact_loss_max"), 1e3, "ms", limits["foot_lifted"]),
        Number("friction used, largest", metrics.get("friction_used_max"), 100, "%", 1.0),
        Number("round trip p50", metrics.get("round_trip_p50"), 1e3, "ms"),
        Number("round trip p99", metrics.get("round_trip_p99"), 1e3, "ms", note=f"servo period {period:.4g} ms"),
    ]  # fmt: skip
    if "steps" in metrics:
        found += _of_stepping(metrics)
    for bus, load in (metrics.get("bus_load") or {}).items():
        lost, errors = metrics["frames_lost"][bus], metrics["bus_errors"][bus]
        note = f"{lost} frames lost, {errors} bus errors"
        found.append(Number(f"load of {bus.replace('_', ' ')}", load, 100, "%", note=note))
    for name, entry in (metrics.get("oscillation") or {}).items():
        if entry is not None:
            doubt = "∞" if entry["growth_error"] is None else f"{2 * entry['growth_error']:.2g}"
            note = f"±{doubt}, at {entry['frequency']:.2g} Hz; limit {limits['growth_rate']:g} 1/s"
            found.append(Number(f"oscillation of {name}, growth", entry["growth"], 1, "1/s", note=note))
    return found


def _of_stepping(metrics: Mapping[str, Any]) -> list[Number]:
    step = "N m per tick"
    return [
        Number("steps", metrics["steps"]),
        Number("tilt in steady steps, largest", metrics["orientation_error_max_steady"], 180.0 / math.pi, "°"),
        Number("foot placement, rms", metrics["foot_placement_error_rms"], 100.0, "cm"),
        Number("foot placement, largest", metrics["foot_placement_error_max"], 100.0, "cm"),
        Number("torque step at lift, largest", metrics["torque_step_at_lift_max"], 1.0, step),
        Number("torque step at touch-down", metrics["torque_step_at_touchdown_max"], 1.0, step),
    ]
