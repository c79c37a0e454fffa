"""Numbers that describe a run; those that decide its verdict are among them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hil.analysis.derived import Derived
from hil.analysis.oscillation import Oscillation, dominant_oscillation
from hil.analysis.stepping import stepping_metrics
from hil.analysis.stiffness import fit_stiffness
from hil.record.signals import Signals
from plant.config import TerrainConfig

Metrics = dict[str, Any]


def compute_metrics(
    tables: Mapping[str, Signals], *, settle: float, terrain: TerrainConfig | None = None, window: float = 3.0
) -> Metrics:
    """All metrics of a run, ready for JSON: SI units, None where a metric has no meaning in this run.

    Args:
        tables: channels ``controller``, ``world``, ``drives`` and ``bus`` by name.
        settle: errors count from this time on, s.
        terrain: ground under the feet; default flat.
        window: length of the end of the run that is searched for oscillations, s.
    """
    derived = Derived(tables, terrain or TerrainConfig(), settle)
    return derived_metrics(derived, window)


def derived_metrics(run: Derived, window: float) -> Metrics:
    """As compute_metrics, from signals derived already."""
    return {
        "duration": float(run.world.seconds[-1]) if len(run.world) else 0.0,
        **_tracking(run),
        **_internal_force(run),
        **_contacts(run),
        **_joints(run),
        **_communication(run),
        "oscillation": {name: _oscillation_entry(o) for name, o in oscillations(run, window).items()},
        **_stiffness(run),
        **stepping_metrics(run),
    }


def oscillations(run: Derived, window: float) -> dict[str, Oscillation | None]:
    """Dominant oscillation at the end of the run of the true errors of CoM [m], orientation [rad] and internal force
    [N]."""
    time = run.controller.seconds
    signals = {
        "com.x": run.com_error[:, 0],
        "com.z": run.com_error[:, 1],
        "roll": run.orientation_error[:, 0],
        "pitch": run.orientation_error[:, 1],
        "internal_force": run.internal_force_true - run.controller["internal_force_reference"],
    }
    settled = run.settled(run.controller)
    return {name: dominant_oscillation(time[settled], values[settled], window) for name, values in signals.items()}


def _number(value: Any) -> float | None:
    """A float for JSON: None instead of NaN and infinity."""
    value = float(value)
    return value if math.isfinite(value) else None


def _largest(values: np.ndarray) -> float | None:
    return _number(np.nanmax(values)) if len(values) and not np.all(np.isnan(values)) else None


def _mean(values: np.ndarray) -> float | None:
    return _number(np.mean(values)) if len(values) else None


def _rms(values: np.ndarray) -> float | None:
    return _number(np.sqrt(np.nanmean(np.square(values)))) if not np.all(np.isnan(values)) else None


def _tracking(run: Derived) -> Metrics:
    settled = run.settled(run.controller)
    error = run.com_distance[settled]
    return {
        "com_error_max": _largest(error),
        "com_error_rms": _rms(error),
        "com_error_max_estimated": _largest(run.com_distance_estimated[settled]),
        "orientation_error_max": _largest(np.abs(run.orientation_error[settled]).ravel()),
    }


def _internal_force(run: Derived) -> Metrics:
    """Errors of the internal force (Kim 2018 (5.3)), as shares of the mean reference where that is not zero."""
    settled = run.settled(run.controller)
    reference = run.controller["internal_force_reference"][settled]
    sensed = run.controller["internal_force"][settled]
    true = run.internal_force_true[settled]
    scale = float(np.mean(np.abs(reference))) if len(reference) else 0.0

    def share(error: np.ndarray) -> float | None:
        return _number(np.mean(np.abs(error)) / scale) if scale > 0.0 else None

    return {
        "internal_force_error": share(sensed - reference),
        "internal_force_error_truth": share(true - reference),
        "internal_force_sensed_vs_truth": share(sensed - true),
        "internal_force_max_abs_error": _largest(np.abs(sensed - reference)),
    }


def _contacts(run: Derived) -> Metrics:
    slips = {foot: _largest(d) for foot, d in run.foot_displacement.items()}
    lifted = {foot: _largest(t) for foot, t in run.lifted_time.items()}
    settled = run.settled(run.world)
    used = [_largest(ratio[settled]) for ratio in run.friction_ratio.values()]
    used_max = max((u for u in used if u is not None), default=None)
    friction = run.terrain.friction
    return {
        "foot_slip": slips,
        "foot_slip_max": max((s for s in slips.values() if s is not None), default=None),
        "contact_loss_max": max((t for t in lifted.values() if t is not None), default=None),
        "friction_used_max": used_max / friction if used_max is not None and friction > 0 else None,
    }


def _joints(run: Derived) -> Metrics:
    settled = run.settled(run.controller)
    joints = run.controller.members("torque_command")
    error = run.controller.group("torque_command") - run.controller.group("torque_sensed")
    return {"torque_error_rms": {joint: _rms(error[settled, j]) for j, joint in enumerate(joints)}}


def _communication(run: Derived) -> Metrics:
    settled = run.settled(run.drives)
    trips = run.drives.group("round_trip")[settled]
    trips = trips[np.isfinite(trips)]
    p50, p99 = (float(p) for p in np.percentile(trips, [50, 99])) if len(trips) else (None, None)
    after = run.settled(run.controller)
    buses = run.bus.members("load")
    loaded = run.bus.group("load")[run.settled(run.bus)]

    def total(prefix: str) -> dict[str, int]:
        """Last value of a count."""
        last = {bus: run.bus[f"{prefix}.{bus}"][-1:] for bus in buses}
        return {bus: int(np.nan_to_num(value).sum()) for bus, value in last.items()}

    def count(name: str) -> int:
        values = run.controller[name]
        return int(np.nanmax(values)) if len(values) and not np.all(np.isnan(values)) else 0

    return {
        "round_trip_p50": p50,
        "round_trip_p99": p99,
        "round_trip_max": _largest(trips),
        "state_age_max": _largest(run.controller["state_age"][after]),
        "missed_states": count("missed_states"),
        "malformed": count("malformed"),
        "bus_load": {bus: _mean(loaded[:, b]) for b, bus in enumerate(buses)},
        "bus_load_peak": {bus: _largest(loaded[:, b]) for b, bus in enumerate(buses)},
        "frames_sent": total("sent"),
        "frames_lost": total("lost"),
        "bus_errors": total("errors"),
    }


def _oscillation_entry(oscillation: Oscillation | None) -> Metrics | None:
    if oscillation is None:
        return None
    return {
        "frequency": oscillation.frequency,
        "amplitude": oscillation.amplitude,
        "growth": oscillation.growth,
        "growth_error": _number(oscillation.growth_error),
    }


def _stiffness(run: Derived) -> Metrics:
    """Stiffness at the CoM from the pushes while the controller balances, by direction."""
    result: Metrics = {}
    balancing = np.isfinite(run.com_error).all(axis=1)
    times = run.controller.seconds[balancing]
    for axis, direction in enumerate("xz"):
        force = run.push[balancing, axis]
        fit = fit_stiffness(times, force, run.com_error[balancing, axis])
        result[f"stiffness_{direction}"] = fit.stiffness if fit else None
        result[f"stiffness_{direction}_samples"] = fit.samples if fit else 0
    return result
