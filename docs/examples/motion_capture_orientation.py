"""How well the torso's orientation is known with and without motion capture: tables and figure of docs/estimation.md.

python docs/examples/motion_capture_orientation.py [stand | sway | figure]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from central_controller.config import MotionCaptureFilterConfig
from central_controller.estimation.motion_capture import MotionCaptureOrientation
from hil.compiled import compile_function
from hil.run import Request, run
from hil.scenario import load
from hil.streams import streams
from plant.config import MotionCaptureConfig, SensorConfig, StanceConfig, TerrainConfig, WorldConfig
from plant.world import World
from robots import description, imu, motion_capture

DRIFT = "sensors.gyro_drift=0.25deg/s"
SEEN = ["motion_capture.enabled=true", "controller.orientation=motion_capture"]
HIDDEN = ["motion_capture.occlusion=0.5", "motion_capture.occlusion_time=200ms"]
BLIND = "inject=[{at='4s', until='9s', key='motion_capture.occluded', value=true}]"
NOT_ESTIMATED = "the same, gyro's bias not estimated"
STANDING = {
    "complementary filter": [],
    "motion capture": SEEN,
    "each LED hidden half of the time, 0.2 s at once": [*SEEN, *HIDDEN],
    "no LED seen from 4 s to 9 s": [*SEEN, BLIND],
    NOT_ESTIMATED: [*SEEN, BLIND, "controller.motion_capture.bias_gain=0"],
    "delay of 5 ms not compensated": [*SEEN, "controller.motion_capture.delay_compensated=false"],
}
SWAYING: dict[str, dict] = {
    "delay of 5 ms compensated": {},
    "delay of 5 ms not compensated": {"delay_compensated": False},
    "no delay": {"delay": 0.0},
    "delay of 50 ms compensated": {"delay": 50e-3},
    "5 ms, each LED hidden half of the time": {"occlusion": 0.5},
    "5 ms, gyro's bias not estimated": {"bias_gain": 0.0},
}
SEEDS = range(4)
ANSWERED_NS = 470_000  # after the sample: the controller's phase and computing time


def standing(settings: list[str], seed: int, begin: float = 2.5) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] (n) from ``begin`` on, and errors [rad] (n, 3) of the controller's orientation, about world axes."""
    outcome = run(Request(load("stand", [DRIFT, *settings]), seed=seed, backend="inline"))
    world, controller = outcome.tables["world"], outcome.tables["controller"]
    times = controller.times - ANSWERED_NS
    keep = (times > begin * 1e9) & (times <= world.times[-1])
    truth = [np.interp(times[keep], world.times, world[f"base.{axis}"]) for axis in ("yaw", "pitch", "roll")]
    found = [controller[axis][keep] for axis in ("yaw", "pitch", "roll")]
    true, estimate = (Rotation.from_euler("ZYX", np.array(angles).T) for angles in (truth, found))
    return times[keep] * 1e-9, (estimate * true.inv()).as_rotvec()


def attitude(t: float) -> Rotation:
    """A torso that sways as in fast stepping: 5° in roll, 3° in yaw at 1.5 Hz, 3° in pitch at 3 Hz."""
    w = 2.0 * np.pi * 1.5
    return Rotation.from_euler("ZYX", np.radians([3 * np.sin(w * t), 3 * np.sin(2 * w * t), 5 * np.cos(w * t)]))


def swaying(seed: int, delay: float = 5e-3, occlusion: float = 0.0, **config) -> tuple[np.ndarray, float, float]:
    """Errors as of ``standing`` of the estimator alone, with the plant's IMU and cameras on a torso that is led
    through ``attitude``; and the time that a sample of the gyro and a frame take [s], the median."""
    robot = description.load("hume")
    sensors = SensorConfig(gyro_drift="0.25 deg/s")
    world = World(
        robot, WorldConfig(planarizer={"enabled": False}), TerrainConfig(), StanceConfig(feet_apart="0.3m"), sensors,
        (), streams(seed), compile_function,
        motion_capture=MotionCaptureConfig(enabled=True, occlusion=occlusion, occlusion_time="0.2s"),
    )  # fmt: skip
    estimator = MotionCaptureOrientation(robot, MotionCaptureFilterConfig(**config), compile_function)
    system = robot.motion_capture

    def lead(at: float) -> None:
        world.data.qpos[3:7] = attitude(at).as_quat(scalar_first=True)
        world.data.qvel[3:6] = (attitude(at - 1e-5).inv() * attitude(at + 1e-5)).as_rotvec() / 2e-5
        mujoco.mj_forward(world.model, world.data)

    errors, under_way, exposure, spent, spent_on_frames = [], [], 0, [], []
    for k in range(15_000):
        now = k * 10**9 // 1500
        while (exposed := exposure * 10**9 // system.rate) <= now:
            lead(exposed * 1e-9)
            under_way.append((exposed + round(delay * 1e9), world.motion_capture.expose(exposed, 0.0)))
            exposure += 1
        lead(now * 1e-9)
        gyro, _ = imu.decode(world.imu(), robot.imu)
        start = time.perf_counter()
        estimator.take_imu(gyro, now)
        spent.append(time.perf_counter() - start)
        while under_way and under_way[0][0] <= now:
            payload = under_way.pop(0)[1]
            start = time.perf_counter()
            estimator.take_frame(motion_capture.decode(payload, system))
            spent_on_frames.append(time.perf_counter() - start)
        if now > 2.5e9:
            errors.append((Rotation.from_quat(estimator.quaternion) * attitude(now * 1e-9).inv()).as_rotvec())
    return np.array(errors), float(np.median(spent)), float(np.median(spent_on_frames))


def row(name: str, errors: list[np.ndarray]) -> None:
    """Print rms and maximum, and what is left of the rms without each seed's mean, which is mostly the LEDs' places."""
    size = np.degrees(np.linalg.norm(np.concatenate(errors), axis=1))
    about = np.degrees(np.linalg.norm(np.concatenate([e - e.mean(axis=0) for e in errors]), axis=1))
    rms, spread = (np.sqrt((values**2).mean()) for values in (size, about))
    print(f"| {name} | {rms:.3f} | {size.max():.3f} | {spread:.3f} |", flush=True)


def head(title: str) -> None:
    print(f"| {title} | rms, ° | greatest, ° | rms about the mean, ° |\n|---|---|---|---|")


def table_of_standing() -> None:
    head("`stand`, 10 s, seeds 0 to 3")
    for name, settings in STANDING.items():
        row(name, [standing(settings, seed)[1] for seed in SEEDS])
    print()


def table_of_swaying() -> None:
    head("swaying torso, 10 s, seeds 0 to 3")
    for name, config in SWAYING.items():
        results = [swaying(seed, **config) for seed in SEEDS]
        row(name, [errors for errors, _, _ in results])
    sample, frame = (1e6 * min(times) for times in list(zip(*results, strict=True))[1:])
    print(f"\nµs per sample of the gyro: {sample:.1f}; per frame: {frame:.1f}")


def figure() -> None:
    _, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    for name in ("complementary filter", "motion capture", "no LED seen from 4 s to 9 s", NOT_ESTIMATED):
        times, errors = standing(STANDING[name], seed=1, begin=1.0)
        axes.plot(times, np.degrees(np.linalg.norm(errors, axis=1)), lw=1, label=name)
    axes.axvspan(4, 9, color="0.93", zorder=0)
    axes.set(xlabel="time [s]", ylabel="error of the orientation [°]", xlim=(1, 10), ylim=(0, None))
    axes.set_title("stand, seed 1, gyro drifting by 0.25 °/s (1σ); grey: LEDs hidden")
    axes.legend()
    plt.savefig(Path(__file__).parents[1] / "motion-capture-orientation.png", dpi=110)


if __name__ == "__main__":
    parts = {"stand": table_of_standing, "sway": table_of_swaying, "figure": figure}
    for part in sys.argv[1:] or parts:
        parts[part]()
