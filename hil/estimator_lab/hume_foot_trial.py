"""The light foot filter at Hume's size (Kim 2018 (6.35)–(6.37)), on Hume that steps, unsupported, on shanks that bend.

The whole emulation runs: drives, buses, controller, cameras. Followed is the LED of each shank as seen from the torso's
LEDs, along the world's axes: where the base is does not matter then. The controller's estimate of q and q̇ tells it by
rigid kinematics, the cameras by what they saw of both; the truth is where the LEDs were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from central_controller.estimation.foot_light import light_filter
from central_controller.estimation.foot_models import FootNoise
from central_controller.estimation.kalman import UNKNOWN
from central_controller.model import RobotModel
from hil.compiled import compile_function
from hil.errors import EmulationError
from hil.estimator_lab.consistency import consistency, normalised
from hil.estimator_lab.foot_trial import Score, rms_and_max
from hil.run import Request, assemble
from hil.scenario import load
from plant.visuals import led_site
from robots.description import Led, Robot

SCENARIO = "balance"
RIGID = 0.0
TUBE = 7000.0  # N m/rad: a carbon tube of 30 mm × 1.5 mm (``plant.config.WorldConfig.shank_stiffness``)
_BEGIN = 2.5  # s: it steps by then
_HIDDEN = (0.5, 0.9)  # s of every second in which the shanks' LEDs are taken for hidden
_LATE = 5e-3  # s, from an exposure to its frame (Kim 2018 App. E)


@dataclass(frozen=True)
class Recording:
    """One foot, a row per servo tick from _BEGIN on. ``exposed``: the places of frames exposed since the tick before;
    ``arrived``: those of the frames that came since then, which are older."""

    rate: float  # Hz
    v: np.ndarray  # (n, 12) as of ``RobotModel``
    jacobian: np.ndarray  # (n, 3, 12)
    kinematics: np.ndarray  # (n, 3) m
    exposed: np.ndarray  # (n, 3) m, nan where none
    arrived: np.ndarray  # (n, 3) m, nan where none
    truth: np.ndarray  # (n, 3) m
    hidden: np.ndarray  # (n,) bool


class _Ticks:
    """Stands before the controller's node and notes what it knows after each tick, and where the LEDs are."""

    def __init__(self, node: Any, leds: Any) -> None:
        self._node, self._space, self._leds = node, node._controller._space, leds
        self.rows: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []

    def start(self, now_ns: int, items: list[Any]) -> None:
        self._node.start(now_ns, items)
        self.rows.append((now_ns, self._space.q.copy(), self._space.v.copy(), self._leds()))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._node, name)


def record(seed: int, duration: float, shank_stiffness: float) -> list[Recording]:
    """Hume's feet, in the robot's order, for ``duration`` [s]; ``shank_stiffness`` [N m/rad], 0: rigid. Raises
    EmulationError when the robot falls."""
    settings = [f"world.shank_stiffness={shank_stiffness!r} N m/rad", f"duration={_BEGIN + duration!r} s"]
    scenario, ticks = load(SCENARIO, settings), None

    def wrap(label: str, node: Any) -> Any:
        nonlocal ticks
        if label != "controller":
            return node
        ticks = _Ticks(node, lambda: places())
        return ticks

    with assemble(Request(scenario, seed=seed, backend="inline", report=False), wrap) as assembly:
        world, system = assembly.world, assembly.system
        robot: Robot = world.robot
        assert robot.motion_capture is not None and ticks is not None
        sites = [world.model.site(led_site(name)).id for name in robot.motion_capture.names]

        def places() -> np.ndarray:
            return world.data.site_xpos[sites].copy()

        system.run_until(round(scenario.duration * 1e9))
        if system.stop_reason is not None:
            raise EmulationError(
                f"{SCENARIO} with seed {seed} and shanks of {shank_stiffness:g} N m/rad: {system.stop_reason}"
            )
        frames = assembly.recorder.tables()["motion_capture"]
    return _recordings(robot, scenario.controller.rate, ticks.rows, frames)


def _recordings(robot: Robot, rate: float, rows: list[Any], frames: Any) -> list[Recording]:
    assert robot.motion_capture is not None
    leds = robot.motion_capture.leds
    torso = [k for k, led in enumerate(leds) if led.link == robot.base.name]
    rows = [row for row in rows if row[0] >= _BEGIN * 1e9]
    times = np.array([row[0] for row in rows])
    v = np.array([row[2] for row in rows])
    exposures = frames.times
    seen = np.stack([np.stack([frames[f"{led.name}.{axis}"] for axis in "xyz"], axis=1) for led in leds])
    hidden = (times * 1e-9 % 1.0 >= _HIDDEN[0]) & (times * 1e-9 % 1.0 < _HIDDEN[1])
    model = RobotModel(robot)
    found = []
    for foot in robot.feet:
        led = next(k for k, led in enumerate(leds) if led.link == foot.joint)
        kinematics, jacobian = _seen_from_torso(model, robot, leds[led], [leds[k] for k in torso], rows)
        told = seen[led] - seen[torso].mean(axis=0)
        exposed, arrived = (_at_ticks(times, exposures + round(late * 1e9), told) for late in (0.0, _LATE))
        was_hidden = np.interp(times - round(_LATE * 1e9), times, hidden) > 0.5  # when what arrives was exposed
        exposed[hidden], arrived[was_hidden] = np.nan, np.nan
        truth = np.array([row[3][led] - row[3][torso].mean(axis=0) for row in rows])
        found.append(Recording(rate, v, jacobian, kinematics, exposed, arrived, truth, hidden))
    return found


def _seen_from_torso(
    model: RobotModel, robot: Robot, led: Led, torso: Sequence[Led], rows: list[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Place (n, 3) and Jacobian (n, 3, 12) of ``led`` from the middle of the torso's LEDs, by rigid kinematics."""
    pinned, data = model.model, model.model.createData()
    knee, base = pinned.getJointId(led.link), pinned.getJointId("base")
    at, middle = np.array(led.position), np.mean([one.position for one in torso], axis=0)
    places, jacobians = [], []
    for _, q, *_ in rows:
        pin.computeJointJacobians(pinned, data, q)
        ends = []
        for joint, point in ((knee, at), (base, middle)):
            arm = data.oMi[joint].rotation @ point
            J = pin.getJointJacobian(pinned, data, joint, pin.LOCAL_WORLD_ALIGNED)
            ends.append((data.oMi[joint].translation + arm, J[:3] - pin.skew(arm) @ J[3:]))
        places.append(ends[0][0] - ends[1][0])
        jacobians.append(ends[0][1] - ends[1][1])
    return np.array(places), np.array(jacobians)


def _at_ticks(times: np.ndarray, known_from: np.ndarray, told: np.ndarray) -> np.ndarray:
    """``told`` (frames, 3) at the first tick from which on it is known; nan at the others."""
    at = np.full((len(times), 3), np.nan)
    ticks = np.searchsorted(times, known_from)
    inside = (ticks > 0) & (ticks < len(times))
    at[ticks[inside]] = told[inside]
    return at


def compare(seeds: Sequence[int], duration: float, shank_stiffness: float) -> list[Score]:
    """Kinematics alone, and the light filter with frames at their exposure and as they arrive, over both feet."""
    noise = FootNoise(mocap="0.6mm", slip=0.05)  # both ends of a distance; a shank that swings bends
    recordings = [one for seed in seeds for one in record(seed, duration, shank_stiffness)]
    hidden = np.concatenate([r.hidden for r in recordings])

    def errors(estimates: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([np.linalg.norm(e - r.truth, axis=1) for e, r in zip(estimates, recordings, strict=True)])

    def score(name: str, estimates: list[np.ndarray], nees: list[np.ndarray] | None = None) -> Score:
        far = errors(estimates)
        known = None if nees is None else consistency(np.array(nees), np.full((len(nees), len(nees[0])), 3.0))
        return Score(name, *rms_and_max(far[~hidden]), *rms_and_max(far[hidden]), foot_nees=known)

    scores = [score("kinematics alone", [r.kinematics for r in recordings])]
    for name, frames in (("light, at exposure", "exposed"), ("light, 5 ms late", "arrived")):
        runs = [_filtered(r, getattr(r, frames), noise) for r in recordings]
        scores.append(score(name, [run[0] for run in runs], [run[1] for run in runs]))
    return scores


def _filtered(recording: Recording, frames: np.ndarray, noise: FootNoise) -> tuple[np.ndarray, np.ndarray]:
    """The filter's places (n, 3) [m] and the NEES of each."""
    n, dofs = recording.v.shape
    filter = light_filter(dofs, 3, noise, compile_function)
    filter.state[:] = np.concatenate([recording.v[0], recording.kinematics[0]])
    filter.covariance[:] = np.diag([noise.initial_rate**2] * dofs + [noise.initial_foot**2] * 3)
    z, variances = np.zeros(dofs + 3), np.array([noise.rate**2] * dofs + [noise.mocap**2] * 3)
    places, nees = np.zeros((n, 3)), np.zeros(n)
    for k in range(n):
        filter.predict(1.0 / recording.rate, recording.jacobian[k].reshape(-1, order="F"))
        new = not np.isnan(frames[k, 0])
        variances[dofs:] = noise.mocap**2 if new else UNKNOWN
        z[:dofs] = recording.v[k]
        if new:
            z[dofs:] = frames[k]
        filter.correct(z, variances)
        places[k] = filter.state[dofs:]
        nees[k] = normalised(places[k] - recording.truth[k], filter.covariance[dofs:, dofs:])
    return places, nees
