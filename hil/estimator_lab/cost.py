"""What the estimators cost of a servo tick of Hume, on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from bus import messages
from central_controller.behaviours.behaviour import Workspace
from central_controller.binding import Bound
from central_controller.config import ControllerConfig, MotionCaptureFilterConfig
from central_controller.estimation.contact import Contact
from central_controller.estimation.foot_light import light_filter
from central_controller.estimation.foot_models import FootNoise
from central_controller.estimation.kalman import UNKNOWN
from central_controller.estimation.motion_capture import MotionCaptureOrientation
from central_controller.estimation.orientation_ekf import OrientationFilter, OrientationNoise
from central_controller.estimation.pendulum_observer import PendulumNoise, PendulumObserver
from central_controller.estimator import filter_constants
from central_controller.law import predict
from central_controller.model import RobotModel
from hil.compiled import compile_function
from robots import description
from robots.motion_capture import Frame

LIMIT = 100e-6  # s: "only 0.1ms is allowed for estimators" (Kim 2018 §6.2.2)
_DT = 1 / 1500.0
_ROBOT = description.load("hume")


def tick_costs(ticks: int = 2000) -> dict[str, float]:
    """Median time [s] of prediction and correction of each estimator that runs in the tick, at Hume's sizes."""
    quaternion, rate = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.1, 0.2, 0.3])
    orientation = OrientationFilter(1 / _DT, OrientationNoise(), compile_function)
    foot = light_filter(12, 3, FootNoise(), compile_function)
    foot.covariance[:] = np.eye(15) * 1e-3
    J, z, variances = np.linspace(-1, 1, 36), np.zeros(15), np.full(15, 1e-4)
    variances[12:] = UNKNOWN
    pendulum = PendulumObserver(0.85, 1 / _DT, PendulumNoise())

    def turn() -> None:
        orientation.predict(rate, True)
        orientation.correct(quaternion, True)

    def place() -> None:
        foot.predict(_DT, J)
        foot.correct(z, variances)

    def fall() -> None:
        pendulum.predict(0.0, 0.1)
        pendulum.correct(0.0, 0.0, 0.1, 0.1)

    system = _ROBOT.motion_capture
    assert system is not None
    cameras = MotionCaptureOrientation(_ROBOT, MotionCaptureFilterConfig(), compile_function)
    seen, places = np.ones(len(system.leds)), np.array([led.position for led in system.leds])
    now = iter(range(0, 10**18, round(_DT * 1e9)))

    def look() -> None:  # a frame in every tick; they come in every third
        exposure_ns = next(now)
        cameras.take_imu(rate, exposure_ns)
        cameras.take_frame(Frame(exposure_ns, 0, seen, places))

    config = ControllerConfig(contact="force")
    model = RobotModel(_ROBOT)
    n = len(_ROBOT.joints)
    space = Workspace(
        _ROBOT, config, model, np.zeros(3 * n), rate, np.array([0.0, 0.0, 9.81]), np.zeros(2),
        np.zeros(model.nq), np.zeros(model.nv),
    )  # fmt: skip
    space.counts[:n] = 0.5 / messages.RADIAN  # bent legs
    remembered = np.concatenate([quaternion, np.zeros(n)])
    joints = Bound(
        compile_function(predict(n)),
        {
            "counts": space.counts, "gyro": space.gyro, "zero": np.zeros(3), "force": space.force,
            "estimate": remembered, "filters": filter_constants(config),
        },
        {"q": space.q, "v": space.v},
    )  # fmt: skip
    joints()
    model.compute(space.q, space.v)
    contact = Contact(space, np.zeros(3), compile_function)

    tasks: dict[str, Callable[[], None]] = {
        "joints and complementary orientation": joints,
        "contact from torques": contact.tell,
        "orientation EKF": turn,
        "orientation from motion capture, with a frame": look,
        "foot position, light filter of 15 states": place,
        "pendulum observer": fall,
    }
    return {name: _median(task, ticks) for name, task in tasks.items()}


def _median(task: Callable[[], None], ticks: int) -> float:
    clock, times = time.perf_counter_ns, np.zeros(ticks)
    for k in range(ticks):
        began = clock()
        task()
        times[k] = clock() - began
    return float(np.median(times[ticks // 4 :])) * 1e-9
