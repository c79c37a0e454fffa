"""Metrics, oscillation, stiffness and verdict against signals with known answers."""

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.messages import Statusword
from central_controller.behaviours.behaviour import Phase
from hil.analysis.derived import Derived
from hil.analysis.metrics import compute_metrics
from hil.analysis.oscillation import Oscillation, dominant_oscillation
from hil.analysis.stiffness import fit_stiffness
from hil.analysis.verdict import Monitor, VerdictConfig, judge
from hil.record.signals import Signals
from hil.scenario import load
from plant.config import TerrainConfig

RATE, DURATION = 500, 8.0
FEET = {"right_foot": 0.25, "left_foot": -0.25}
JOINTS = ["right_knee", "left_knee"]
BUSES = ["right_leg", "left_leg"]
WEIGHT = 300.0

CHANNELS = {
    "world": ["com.x", "com.z", "base.roll", "base.pitch", "hoist", "internal_force", "push.x", "push.z",
              *(f"{what}.{foot}.{axis}" for what in ("foot", "contact") for foot in FEET for axis in "xyz")],
    "controller": ["com.x", "com.z", "com_reference.x", "com_reference.z", "roll_reference", "pitch_reference",
                   "internal_force", "internal_force_reference", "state_age", "phase", "missed_states", "malformed",
                   *(f"{what}.{joint}" for what in ("torque_command", "torque_sensed") for joint in JOINTS)],
    "drives": [f"{what}.{joint}" for what in ("statusword", "error", "round_trip") for joint in JOINTS],
    "bus": [f"{what}.{bus}" for what in ("load", "sent", "lost", "errors") for bus in BUSES],
}  # fmt: skip


class Run:
    """A perfect run on flat ground, one signal of which a test can change: ``run.world["com.x"][:] = …``."""

    def __init__(self, duration: float = DURATION, rate: int = RATE) -> None:
        n = round(duration * rate)
        times = np.arange(n, dtype=np.int64) * (10**9 // rate)
        delays = {"world": 0, "controller": 470_000, "drives": 470_000, "bus": 470_000}
        self.tables = {
            name: Signals(times + delays[name], tuple(names), np.zeros((n, len(names))))
            for name, names in CHANNELS.items()
        }
        self.world, self.controller, self.drives, self.bus = (self.tables[name] for name in CHANNELS)
        self.t = times * 1e-9
        self.world["com.z"][:] = self.controller["com.z"][:] = self.controller["com_reference.z"][:] = 0.8
        self.controller["phase"][:] = Phase.ON
        self.controller["internal_force_reference"][:] = 100.0
        self.controller["internal_force"][:] = self.world["internal_force"][:] = 100.0
        self.world["hoist"][self.t < 1.0] = 1.0
        self.drives["statusword.right_knee"][:] = self.drives["statusword.left_knee"][:] = Statusword.OPERATION_ENABLED
        for foot, x in FEET.items():
            self.world[f"foot.{foot}.x"][:] = x
            self.world[f"contact.{foot}.z"][:] = -WEIGHT

    def metrics(self, settle: float = 2.5, terrain: TerrainConfig | None = None) -> dict[str, Any]:
        return compute_metrics(self.tables, settle=settle, terrain=terrain)

    def verdict(self, *settings: str, stopped: str | None = None) -> Any:
        return judge(self.tables, load("stand", [f"duration={DURATION}s", *settings]), stopped)

    def monitor(self, **limits: Any) -> tuple[int, str] | None:
        """Time in ms and reason of what the monitor says first, at every tenth of a second."""
        monitor = Monitor(VerdictConfig.model_validate(limits), CHANNELS)
        for row in range(0, len(self.t), RATE // 10):
            now = int(self.world.times[row])
            reason = monitor.check(now, *(self.tables[name].data[row] for name in ("world", "controller", "drives")))
            if reason is not None:
                return now // 10**6, reason
        return None


# --- metrics --------------------------------------------------------------------------------------


def test_a_perfect_run_has_no_errors_and_is_stable() -> None:
    run = Run()
    verdict = run.verdict()
    assert verdict.stable and verdict.reason == "stood to the end within all limits"
    m = verdict.metrics
    assert m["com_error_max"] == m["com_error_rms"] == m["orientation_error_max"] == m["foot_slip_max"] == 0.0
    assert m["internal_force_error"] == m["internal_force_error_truth"] == m["contact_loss_max"] == 0.0
    assert m["friction_used_max"] == pytest.approx(0.0, abs=1e-12)
    assert run.monitor() is None


def test_errors_of_the_centre_of_mass_are_those_after_settling() -> None:
    run = Run()
    run.world["com.x"][:] = np.where(run.t < 2.0, 1.0, 0.03 * np.sin(2 * np.pi * run.t))
    run.world["com.z"][:] += np.where(run.t < 2.0, 1.0, 0.04 * np.sin(2 * np.pi * run.t))
    run.controller["com.x"][:] = 0.01
    metrics = run.metrics(settle=3.0)
    assert metrics["com_error_max"] == pytest.approx(0.05, rel=1e-3)
    assert metrics["com_error_rms"] == pytest.approx(0.05 / math.sqrt(2), rel=1e-3)
    assert metrics["com_error_max_estimated"] == pytest.approx(0.01)


def test_errors_count_from_where_the_feet_stand_and_not_from_where_they_hung() -> None:
    """The controller knows only its feet: both find their place on the panels until the hoist lets go at 1 s."""
    run = Run()
    for name in ("foot.right_foot", "foot.left_foot", "com"):
        run.world[f"{name}.x"][run.t >= 0.9] += 0.06
        run.world[f"{name}.z"][run.t >= 0.9] -= 0.08
    assert run.metrics()["com_error_max"] == pytest.approx(0.0, abs=1e-12)
    assert run.monitor() is None
    run.world["com.x"][run.t >= 4.0] += 0.06  # beyond the limit of 5 cm, the feet stay
    assert run.metrics()["com_error_max"] == pytest.approx(0.06)
    assert run.monitor() == (4000, "CoM error 60.0 mm (limit 50.0 mm) at 4.00 s")


def test_a_drive_that_says_nothing_ends_the_run() -> None:
    run = Run()
    run.controller["state_age"][run.t >= 3.0] = 0.099
    assert run.monitor() is None
    run.controller["state_age"][run.t >= 4.0] = 0.101
    assert run.monitor() == (4000, "drive silent: no state of one for 101 ms (limit 100 ms) at 4.00 s")


def test_there_is_no_error_before_there_is_a_reference() -> None:
    """The controller's row holds zeros until it leaves its first phase."""
    run = Run()
    early = run.t < 4.0
    run.controller["phase"][early] = Phase.OFF
    run.controller["com_reference.z"][early] = 0.0
    run.world["com.x"][:] = 0.01
    metrics = run.metrics()
    assert [metrics["com_error_max"], metrics["com_error_rms"]] == pytest.approx([0.01, 0.01])
    assert np.isnan(Derived(run.tables, TerrainConfig(), 2.5).com_distance[early]).all()


def test_the_world_is_taken_as_it_was_just_before_the_controllers_row() -> None:
    run = Run()
    run.world["com.x"][:] = run.t
    run.controller["com_reference.x"][:] = run.t
    assert run.metrics()["com_error_max"] == 0.0


def test_internal_force_errors_are_shares_of_the_reference() -> None:
    run = Run()
    run.controller["internal_force_reference"][:] = 200.0
    run.controller["internal_force"][:] = 200.0 + 10.0 * np.where(np.arange(len(run.t)) % 2, 1, -1)
    run.world["internal_force"][:] = 170.0
    metrics = run.metrics()
    assert metrics["internal_force_error"] == pytest.approx(0.05)
    assert metrics["internal_force_error_truth"] == pytest.approx(0.15)
    assert metrics["internal_force_sensed_vs_truth"] == pytest.approx(0.15)
    assert metrics["internal_force_max_abs_error"] == pytest.approx(10.0)
    run.controller["internal_force_reference"][:] = 0.0
    assert run.metrics()["internal_force_error"] is None  # a share of nothing


@given(st.floats(-10, 10))
def test_angles_are_compared_around_the_circle(angle: float) -> None:
    run = Run(duration=3.0, rate=50)
    run.world["base.roll"][:] = angle
    run.controller["roll_reference"][:] = angle + 2 * np.pi * round(angle)
    assert run.metrics(settle=1.0)["orientation_error_max"] == pytest.approx(0.0, abs=1e-9)


def test_a_foot_is_displaced_only_while_it_is_loaded_and_since_the_release() -> None:
    run = Run()
    foot = run.world["foot.left_foot.x"]
    foot[run.t < 1.0] += 0.5
    foot[run.t >= 4.0] += 0.003
    lifted = (run.t >= 5.0) & (run.t < 5.3)
    foot[lifted] += 0.2
    run.world["contact.left_foot.z"][lifted] = -4.0
    metrics = run.metrics()
    assert metrics["foot_slip"] == {"right_foot": 0.0, "left_foot": pytest.approx(0.003)}
    assert metrics["contact_loss_max"] == pytest.approx(0.3, abs=2 / RATE)


def test_friction_is_used_by_the_force_along_the_ground() -> None:
    run = Run()
    run.world["contact.left_foot.x"][:] = 0.3 * WEIGHT
    assert run.metrics(terrain=TerrainConfig(friction=0.6))["friction_used_max"] == pytest.approx(0.5)


def test_friction_on_panels_is_that_of_the_inclined_plane() -> None:
    """Weight alone on a slope of 30° uses tan(30°); the panels face each other."""
    run = Run()
    terrain = TerrainConfig.model_validate({"kind": "split", "panel_angle": "30deg", "friction": 1.0})
    assert run.metrics(terrain=terrain)["friction_used_max"] == pytest.approx(math.tan(math.radians(30)))
    for foot, x in FEET.items():  # pushed apart until the force is square on the panel
        run.world[f"contact.{foot}.x"][:] = math.copysign(math.tan(math.radians(30)) * WEIGHT, x)
    assert run.metrics(terrain=terrain)["friction_used_max"] == pytest.approx(0.0, abs=1e-12)


def test_latencies_loads_and_counts() -> None:
    run = Run()
    trips = run.drives["round_trip.left_knee"]
    trips[:] = np.nan
    trips[::2] = np.linspace(1e-3, 3e-3, len(trips[::2]))
    run.drives["round_trip.right_knee"][:] = np.nan
    run.bus["load.left_leg"][:] = np.where(run.t < 2.5, 0.9, np.where(np.arange(len(run.t)) % 2, 0.5, 0.7))
    run.bus["lost.left_leg"][:] = np.arange(len(run.t))
    run.controller["missed_states"][:] = 7
    metrics = run.metrics()
    settled = trips[run.drives.times >= 2_500_000_000]
    settled = settled[np.isfinite(settled)]
    assert [metrics[f"round_trip_{p}"] for p in ("p50", "p99", "max")] == [
        pytest.approx(np.percentile(settled, p)) for p in (50, 99, 100)
    ]
    assert metrics["bus_load"] == {"right_leg": 0.0, "left_leg": pytest.approx(0.6, abs=1e-3)}
    assert metrics["bus_load_peak"]["left_leg"] == pytest.approx(0.7)
    assert metrics["frames_lost"] == {"right_leg": 0, "left_leg": len(run.t) - 1}
    assert metrics["missed_states"] == 7


def test_torque_errors_by_joint() -> None:
    run = Run()
    run.controller["torque_command.left_knee"][:] = 3.0
    assert run.metrics()["torque_error_rms"] == {"right_knee": 0.0, "left_knee": pytest.approx(3.0)}


@pytest.mark.parametrize("duration", [0.0, 1 / RATE, 0.02, 1.0, 2.6])
def test_records_of_any_length_have_metrics_for_json(duration: float) -> None:
    json.dumps(Run(duration).metrics(), allow_nan=False)


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_missing_or_undefined_channel_leaves_gaps_instead_of_numbers(channel: str) -> None:
    run = Run()
    run.tables[channel].data[:] = np.nan
    json.dumps(run.metrics(), allow_nan=False)
    empty = Signals(np.empty(0, np.int64), tuple(CHANNELS[channel]), np.empty((0, len(CHANNELS[channel]))))
    metrics = compute_metrics({**run.tables, channel: empty}, settle=2.5)
    json.dumps(metrics, allow_nan=False)
    if channel in ("world", "controller"):
        assert metrics["com_error_max"] is None and metrics["internal_force_error_truth"] is None
        assert not judge({**run.tables, channel: empty}, load("stand"), None).stable


# --- oscillation ----------------------------------------------------------------------------------


@given(st.floats(2.0, 40.0), st.floats(-1.0, 1.0), st.floats(0, 6.3), st.floats(1e-6, 1.0), st.integers(0, 100))
def test_a_growing_sine_is_measured(frequency: float, growth: float, phase: float, size: float, seed: int) -> None:
    t = np.arange(0.0, 5.0, 1 / RATE)
    drift = 0.2 + 0.1 * t - 0.01 * t**3  # a slow path is no oscillation
    noise = 0.005 * np.random.default_rng(seed).normal(size=len(t))
    x = size * (drift + noise + 0.05 * np.exp(growth * (t - t[-1])) * np.sin(2 * np.pi * frequency * t + phase))
    found = dominant_oscillation(t, x)
    assert found is not None
    assert found.frequency == pytest.approx(frequency, abs=0.05)
    assert abs(found.growth - growth) < 0.05 + 0.2 * abs(growth) + 3.0 * found.growth_error  # few periods at 2 Hz
    if growth > -0.3:  # of one that dies out, what removing the drift leaves at the end is as large
        # told for the end, by the growth found, from the middle of the window, which is 1.5 s earlier
        assert found.amplitude == pytest.approx(0.05 * size, rel=0.25 + 1.5 * abs(found.growth - growth))


def test_the_error_of_the_growth_rate_is_its_scatter() -> None:
    t = np.arange(0.0, 3.0, 1 / RATE)
    rng = np.random.default_rng(3)
    found = [
        dominant_oscillation(t, 0.01 * np.sin(2 * np.pi * 6.0 * t) + 0.01 * rng.normal(size=len(t))) for _ in range(200)
    ]
    growths = np.array([f.growth for f in found if f is not None])
    errors = np.array([f.growth_error for f in found if f is not None])
    assert np.std(growths) == pytest.approx(np.median(errors), rel=0.3)
    assert np.mean(np.abs(growths) > 2 * errors) < 0.15


def test_what_is_too_slow_too_short_constant_or_undefined_does_not_oscillate() -> None:
    t = np.arange(0.0, 3.0, 1 / RATE)
    assert dominant_oscillation(t, np.zeros_like(t)) is None
    assert dominant_oscillation(t[:10], np.sin(t[:10])) is None
    assert dominant_oscillation(t[: len(t) // 2], np.sin(40 * t[: len(t) // 2])) is None
    assert dominant_oscillation(t, np.where(t < 2.0, np.sin(40 * t), np.nan)) is None
    slow = dominant_oscillation(t, np.sin(2 * np.pi * 0.25 * t))
    assert slow is None or (slow.amplitude < 0.1 and not slow.grows(0.2, 0.0))


def test_growth_needs_size_rate_and_certainty() -> None:
    grown = Oscillation(frequency=5.0, amplitude=0.01, growth=0.5, growth_error=0.1)
    assert grown.grows(rate=0.29, amplitude=0.0099)
    assert not grown.grows(rate=0.31, amplitude=0.0099)  # within two standard errors
    assert not grown.grows(rate=0.29, amplitude=0.01)
    assert not Oscillation(5.0, 0.01, 0.5, math.inf).grows(0.0, 0.0)


# --- stiffness ------------------------------------------------------------------------------------


def pushed(t: np.ndarray, force: float, ramp: float = 1.0) -> np.ndarray:
    """A trapezoid from 2 s to 6 s."""
    return force * np.clip(np.minimum((t - 2.0) / ramp, (6.0 - t) / ramp), 0.0, 1.0)


@given(st.floats(100, 5000), st.floats(10, 100), st.sampled_from([1, -1]), st.floats(-0.02, 0.02))
def test_the_stiffness_of_a_spring_is_found(stiffness: float, force: float, sign: int, offset: float) -> None:
    t = np.arange(0.0, 8.0, 1 / RATE)
    push = pushed(t, sign * force)
    found = fit_stiffness(t, push, offset + push / stiffness)
    assert found is not None and found.stiffness == pytest.approx(stiffness, rel=1e-3)
    assert found.samples == pytest.approx(4.0 * RATE, rel=0.06)


def test_the_stiffness_of_a_damped_mass_on_a_spring_is_found_through_noise() -> None:
    k, m, d = 800.0, 20.0, 150.0
    t = np.arange(0.0, 8.0, 1 / RATE)
    push, x, v, xs = pushed(t, -40.0), 0.0, 0.0, []
    for f in push:
        v += (f - k * x - d * v) / m / RATE
        x += v / RATE
        xs.append(x)
    noise = 0.002 * np.random.default_rng(1).normal(size=len(t))
    found = fit_stiffness(t, push, np.array(xs) + noise)
    assert found is not None and found.stiffness == pytest.approx(k, rel=0.02)


def test_without_a_push_or_a_restoring_force_there_is_no_stiffness() -> None:
    t = np.arange(0.0, 8.0, 1 / RATE)
    assert fit_stiffness(t, np.zeros_like(t), np.sin(t)) is None
    assert fit_stiffness(t, pushed(t, 50.0), -pushed(t, 0.1)) is None  # it comes towards whoever pushes
    assert fit_stiffness(t[:20], np.full(20, 50.0), np.zeros(20)) is None
    assert fit_stiffness(t[:0], t[:0], t[:0]) is None


def test_stiffness_by_direction_is_among_the_metrics_whatever_came_before_the_reference() -> None:
    run = Run()
    run.world["push.x"][:] = pushed(run.t, 30.0)
    run.world["com.x"][:] = pushed(run.t, 30.0) / 600.0
    run.controller["phase"][run.t < 1.0] = Phase.OFF
    metrics = run.metrics()
    assert metrics["stiffness_x"] == pytest.approx(600.0, rel=1e-3) and metrics["stiffness_z"] is None
    assert metrics["stiffness_x_samples"] > 0 == metrics["stiffness_z_samples"]


# --- verdict: each limit, just within and just beyond ---------------------------------------------


@pytest.mark.parametrize("signal, value, limit, words", [
    ("com.x", 0.05, {"com_error": "5cm"}, r"CoM error 50.0 mm \(limit 50.0 mm\) at 5.00 s"),
    ("base.roll", -0.26, {"orientation_error": "0.26rad"}, r"torso tilted by 14.9° \(limit 14.9°\) at 5.00 s"),
    ("base.pitch", 0.26, {"orientation_error": "0.26rad"}, r"torso tilted by 14.9° \(limit 14.9°\) at 5.00 s"),
    ("foot.left_foot.y", 0.03, {"foot_slip": "3cm"}, r"foot slipped: left_foot by 30 mm \(limit 30 mm\) at 5.00 s"),
])  # fmt: skip
def test_a_limit_ends_the_run_when_it_is_passed(signal: str, value: float, limit: dict[str, str], words: str) -> None:
    within, beyond = Run(), Run()
    within.world[signal][within.t >= 5.0] += 0.9999 * value
    beyond.world[signal][beyond.t >= 5.0] += 1.0001 * value
    assert within.monitor(**limit) is None
    found = beyond.monitor(**limit)
    assert found is not None and found[0] == 5000 and re.fullmatch(words, found[1])
    early = Run()
    early.world[signal][early.t < 0.9] += 1.5 * value  # while it settles, or hangs
    assert early.monitor(**limit) is None


def test_a_fall_is_seen_at_any_time() -> None:
    for at in (0.5, 5.0):
        run = Run()
        run.world["com.z"][run.t >= at] = 0.6 * 0.8 + 1e-6
        assert (run.monitor(com_error="1m")) is None
        run.world["com.z"][run.t >= at] = 0.6 * 0.8 - 1e-6
        found = run.monitor(com_error="1m")
        assert found == (round(at * 1e3), f"fallen: CoM at 0.48 m, 60 % of its start, at {at:.2f} s")


def test_a_simulation_that_diverges_is_named() -> None:
    run = Run()
    run.world.data[run.t >= 3.0] = np.nan
    assert run.monitor() == (3000, "the simulation diverged at 3.00 s")


@pytest.mark.parametrize("status, what", [
    (Statusword.FAULT, "fault"), (Statusword.FAULT_REACTION_ACTIVE, "fault"),
    (Statusword.QUICK_STOP_ACTIVE, "quick stop"),
])  # fmt: skip
def test_a_drive_in_fault_is_named_with_its_cause(status: int, what: str) -> None:
    run = Run()
    run.drives["statusword.left_knee"][run.t >= 3.0] = status
    run.drives["error.left_knee"][:] = 10
    assert run.monitor() == (3000, f"drive in {what}: left_knee, over torque (8311h), at 3.00 s")


def test_errors_do_not_count_before_the_controller_balances() -> None:
    run = Run()
    run.controller["phase"][:] = Phase.OFF
    run.controller["com_reference.z"][:] = 0.0
    assert run.monitor() is None
    verdict = run.verdict()
    assert not verdict.stable and verdict.reason == "the drives were never all switched on"


@pytest.mark.parametrize("seconds, stable", [(0.09, True), (0.12, False)])
def test_a_foot_that_should_hold_must_not_be_lost_for_long(seconds: float, stable: bool) -> None:
    run = Run()
    run.world["contact.right_foot.z"][(run.t >= 4.0) & (run.t < 4.0 + seconds)] = 0.0
    verdict = run.verdict("limits.foot_lifted=0.1s")
    assert verdict.stable == stable
    assert stable or verdict.reason == "a foot was without load for 0.12 s (limit 0.1 s)"


@pytest.mark.parametrize("channel, name", [("com.x", "com.x"), ("com.z", "com.z"), ("base.roll", "roll")])
@pytest.mark.parametrize("growth, size, stable", [(0.5, 0.02, False), (0.1, 0.02, True), (0.5, 0.004, True),
                                                  (-0.5, 0.02, True)])  # fmt: skip
def test_a_growing_oscillation_is_unstable(channel: str, name: str, growth: float, size: float, stable: bool) -> None:
    run = Run()
    run.world[channel][:] += size * np.exp(growth * (run.t - DURATION)) * np.sin(2 * np.pi * 4.0 * run.t)
    verdict = run.verdict("limits.growth_rate=0.2", "limits.growth_amplitude=5mm")
    assert verdict.stable == stable
    words = rf"growing oscillation of {name} at 4\.0 Hz, 0\.5\d? 1/s \(limit 0\.2 1/s\)"
    assert stable or re.fullmatch(words, verdict.reason)


@pytest.mark.parametrize("growth, size, held, stable", [(0.5, 6.0, 100, False), (0.1, 6.0, 100, True),
                                                        (0.5, 3.0, 100, True), (0.5, 6.0, -100, False),
                                                        (0.5, 6.0, 200, True), (0.5, 6.0, 0, True)])  # fmt: skip
def test_a_growing_oscillation_of_the_internal_force_counts_against_the_force_to_be_held(
    growth: float, size: float, held: float, stable: bool
) -> None:
    run = Run()
    run.controller["internal_force_reference"][:] = run.world["internal_force"][:] = held
    run.world["internal_force"][:] += size * np.exp(growth * (run.t - DURATION)) * np.sin(2 * np.pi * 8.5 * run.t)
    verdict = run.verdict("limits.growth_force=0.04", f"controller.internal_force.reference={held}N")
    assert verdict.stable == stable
    words = r"growing oscillation of internal force at 8\.5 Hz, 0\.(49|5\d?) 1/s \(limit 0\.2 1/s\)"
    assert stable or re.fullmatch(words, verdict.reason), verdict.reason


def test_what_the_monitor_said_is_the_reason() -> None:
    verdict = Run().verdict(stopped="fallen: …")
    assert (verdict.stable, verdict.reason) == (False, "fallen: …") and verdict.metrics["com_error_max"] == 0.0


def test_a_run_that_ends_before_errors_count_says_so() -> None:
    verdict = Run().verdict(f"limits.settle={DURATION}s")
    assert verdict.stable and verdict.reason == "stood to the end, which is before errors count (8 s)"


def test_nothing_simulated_is_not_stable() -> None:
    verdict = judge(Run(0.0).tables, load("stand"), None)
    assert (verdict.stable, verdict.reason) == (False, "nothing was simulated")
