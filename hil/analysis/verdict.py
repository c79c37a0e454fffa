"""The verdict: what makes a run unstable, and which of it came first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from bus.drive_faults import EMERGENCIES, DriveFault
from bus.messages import Statusword
from hil.analysis.oscillation import Oscillation
from robots.quantities import Config, Gain, Metres, Radians, Seconds

if TYPE_CHECKING:
    from hil.record.signals import Signals
    from hil.scenario import Scenario


class VerdictConfig(Config):
    """Limits of a stable run."""

    settle: Seconds = 2.5  # errors count from here on
    com_error: Annotated[Metres, Field(ge=0)] = 0.05
    orientation_error: Annotated[Radians, Field(ge=0)] = 0.26
    foot_slip: Annotated[Metres, Field(ge=0)] = 0.03
    foot_lifted: Seconds = 0.1  # longest without load
    drive_silent: Seconds = 0.1  # longest without a state of every drive at the controller
    fall_height: Gain = 0.6  # share of the CoM's height at the start below which the robot has fallen
    growth_rate: Gain = 0.2  # 1/s of an oscillation
    growth_amplitude: Annotated[Metres, Field(ge=0)] = 0.005  # m or rad, from which growth counts
    # The same of the internal force, as a share of the one to be held: a tenth of what it can lose before a foot slips,
    # as growth_amplitude is a tenth of com_error. Hume, 229 N, its feet 0.5 m by 0.2 m apart on 45° panels of friction
    # 0.6, stands by 64 N of 100 N: T/N there is sqrt((114.5 − 29.7)²/2 + 11.9²) / ((114.5 + 29.7)/√2) = 0.6.
    growth_force: Gain = 0.04


_ON = 3  # the controller's phase in which its torques are whole (central_controller.controller.Phase)


@dataclass(frozen=True)
class Verdict:
    stable: bool
    reason: str
    metrics: dict[str, Any]


class Monitor:
    """Watches a run while it goes on, so that one that has failed ends with its reason instead of its duration."""

    def __init__(self, limits: VerdictConfig, channels: Mapping[str, Sequence[str]]) -> None:
        self._limits = limits
        world, controller = list(channels["world"]), list(channels["controller"])
        self._drives = list(channels["drives"])
        self._n = len(self._drives) // 3
        self._com = [world.index(f"com.{axis}") for axis in "xz"]
        self._hoist = world.index("hoist")
        self._angles = [world.index("base.roll"), world.index("base.pitch")]
        self._feet = [world.index(n) for n in world if n.startswith("foot.") and n.endswith(".x")]
        self._feet_names = [world[i].split(".")[1] for i in self._feet]
        self._reference = [controller.index(f"com_reference.{axis}") for axis in "xz"]
        self._phase = controller.index("phase")
        self._state_age = controller.index("state_age")
        self._height: float | None = None
        self._stood: list[np.ndarray] | None = None
        self._origin = (0.0, 0.0)  # x, z of the midpoint of the feet then, which is the controller's origin

    def snapshot(self) -> dict[str, Any]:
        stood = None if self._stood is None else [place.copy() for place in self._stood]
        return {"height": self._height, "stood": stood, "origin": self._origin}

    def restore(self, state: dict[str, Any]) -> None:
        self._height, self._stood, self._origin = state["height"], state["stood"], state["origin"]

    def fallen(self, now_ns: int, world: np.ndarray) -> str | None:
        """One sentence when the robot has fallen by now, else None."""
        time, height = now_ns * 1e-9, world[self._com[1]]
        if self._height is None:
            self._height = height
        if not math.isfinite(height):
            return f"the simulation diverged at {time:.2f} s"
        if height < self._limits.fall_height * self._height:
            return f"fallen: CoM at {height:.2f} m, {100 * height / self._height:.0f} % of its start, at {time:.2f} s"
        return None

    def check(self, now_ns: int, world: np.ndarray, controller: np.ndarray, drives: np.ndarray) -> str | None:
        """One sentence when the run has failed by now, else None."""
        fallen = self.fallen(now_ns, world)
        if fallen is not None:
            return fallen
        limits, time = self._limits, now_ns * 1e-9
        for joint in range(self._n):
            status = int(drives[joint]) & Statusword.MASK
            if status in (Statusword.FAULT, Statusword.QUICK_STOP_ACTIVE, Statusword.FAULT_REACTION_ACTIVE):
                name = self._drives[joint].partition(".")[2]
                what = "quick stop" if status == Statusword.QUICK_STOP_ACTIVE else "fault"
                return f"drive in {what}: {name}, {_cause(int(drives[self._n + joint]))}, at {time:.2f} s"
        if controller[self._phase] >= _ON and controller[self._state_age] > limits.drive_silent:
            age, limit = 1e3 * controller[self._state_age], 1e3 * limits.drive_silent
            return f"drive silent: no state of one for {age:.0f} ms (limit {limit:.0f} ms) at {time:.2f} s"
        if world[self._hoist] > 0:
            return None
        if self._stood is None:
            self._stood = [world[i : i + 3].copy() for i in self._feet]
            x, _, z = np.mean(self._stood, axis=0).tolist()
            self._origin = x, z
        for name, start, i in zip(self._feet_names, self._stood, self._feet, strict=True):
            slip = math.dist(world[i : i + 3], start)
            if slip > limits.foot_slip:
                limit = f"(limit {1e3 * limits.foot_slip:.0f} mm)"
                return f"foot slipped: {name} by {1e3 * slip:.0f} mm {limit} at {time:.2f} s"
        if time < limits.settle or controller[self._phase] < _ON:
            return None
        x, z = self._origin
        com_x, com_z = world[self._com].tolist()
        error = math.dist((com_x - x, com_z - z), controller[self._reference])
        if error > limits.com_error:
            return f"CoM error {1e3 * error:.1f} mm (limit {1e3 * limits.com_error:.1f} mm) at {time:.2f} s"
        angle = float(np.abs(world[self._angles]).max())
        if angle > limits.orientation_error:
            limit = f"(limit {math.degrees(limits.orientation_error):.1f}°)"
            return f"torso tilted by {math.degrees(angle):.1f}° {limit} at {time:.2f} s"
        return None


class FallMonitor(Monitor):
    """Lets a run go on whatever else is wrong, until the robot has fallen."""

    def check(self, now_ns: int, world: np.ndarray, controller: np.ndarray, drives: np.ndarray) -> str | None:
        return self.fallen(now_ns, world)


def _cause(number: int) -> str:
    """The fault that a drive's state tells, with the error code of its emergency."""
    try:
        fault = DriveFault(number)
    except ValueError:
        return f"fault {number}, which no drive has"
    if fault is DriveFault.NONE:
        return "commanded"
    return f"{fault.name.lower().replace('_', ' ')} ({EMERGENCIES[fault].code:04X}h)"


def judge(tables: Mapping[str, Signals], scenario: Scenario, stopped: str | None) -> Verdict:
    """Verdict and metrics of a finished run; ``stopped`` is what the monitor ended it for."""
    from hil.analysis.metrics import compute_metrics

    limits = scenario.limits
    if not len(tables["world"]) or not len(tables["controller"]):
        return Verdict(False, "nothing was simulated", {})
    metrics = compute_metrics(tables, settle=limits.settle, terrain=scenario.terrain)
    if stopped is not None:
        return Verdict(False, stopped, metrics)
    lifted = metrics["contact_loss_max"]
    if lifted is not None and lifted > limits.foot_lifted:
        limit = f"(limit {limits.foot_lifted:g} s)"
        return Verdict(False, f"a foot was without load for {lifted:.2f} s {limit}", metrics)
    for name, entry in metrics["oscillation"].items():
        if entry is None or entry["growth_error"] is None:
            continue
        oscillation = Oscillation(**entry)
        from_amplitude = limits.growth_amplitude
        if name == "internal_force":
            from_amplitude = limits.growth_force * abs(scenario.controller.internal_force.reference) or math.inf
        if oscillation.grows(limits.growth_rate, from_amplitude):
            what = f"growing oscillation of {name.replace('_', ' ')} at {oscillation.frequency:.1f} Hz"
            rate = f"{oscillation.growth:.2f} 1/s (limit {limits.growth_rate:g} 1/s)"
            return Verdict(False, f"{what}, {rate}", metrics)
    if scenario.duration <= limits.settle:
        return Verdict(True, f"stood to the end, which is before errors count ({limits.settle:g} s)", metrics)
    if tables["controller"]["phase"][-1] < _ON:
        return Verdict(False, "the drives were never all switched on", metrics)
    return Verdict(True, "stood to the end within all limits", metrics)
