"""Orientation from motion capture and gyro: the fit as printed, rotations against scipy, delays against an oracle."""

from __future__ import annotations

import pickle
import time
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from central_controller.config import MotionCaptureFilterConfig
from central_controller.estimation.motion_capture import MotionCaptureOrientation, affine_fit
from central_controller.rotations import inverse, logarithm, nearest_rotation, quaternion_of
from hil.compiled import compile_function
from robots import description
from robots.motion_capture import Frame

ROBOT = description.load("hume")
SYSTEM = ROBOT.motion_capture
BODY = [i for i, led in enumerate(SYSTEM.leds) if led.link == "torso"]
PATTERN = np.array([SYSTEM.leds[i].position for i in BODY])
RATE = 1500
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
CENTRE = np.array([0.3, -0.2, 0.75])

_M, _Q, _L = ca.SX.sym("m", 3, 3), ca.SX.sym("q", 4), ca.SX.sym("l")
_P, _Y, _W = ca.SX.sym("p", 3, 7), ca.SX.sym("y", 3, 7), ca.SX.sym("w", 7)
NEAREST = ca.Function("nearest", [_M], [nearest_rotation(_M)])
QUATERNION = ca.Function("quaternion", [_M], [quaternion_of(_M)])
LOGARITHM = ca.Function("logarithm", [_Q], [logarithm(_Q)])
INVERSE = ca.Function("inverse", [_Q], [inverse(_Q)])
FIT = ca.Function("fit", [_P, _Y, _W, _M, _L], list(affine_fit(_P, _Y, _W, _M, _L)))

unit = st.floats(-1, 1, allow_subnormal=False)
rotations = st.tuples(unit, unit, unit, unit).filter(lambda q: np.linalg.norm(q) > 0.1).map(Rotation.from_quat)


# --- the algebra ------------------------------------------------------------------------------------------------


@given(rotations)
def test_quaternions_of_rotations_are_scipys(rotation: Rotation) -> None:
    found = np.array(QUATERNION(rotation.as_matrix())).ravel()
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-14)
    assert (Rotation.from_quat(found) * rotation.inv()).magnitude() < 1e-13
    back = np.array(INVERSE(found)).ravel()
    assert (Rotation.from_quat(back) * rotation).magnitude() < 1e-13
    vector = np.array(LOGARITHM(found)).ravel()
    assert (Rotation.from_rotvec(vector) * rotation.inv()).magnitude() < 1e-12
    assert np.linalg.norm(vector) <= np.pi + 1e-12


@pytest.mark.parametrize("vector", [(np.pi, 0, 0), (0, np.pi, 0), (0, 0, -np.pi), (0, 0, 0), (2.2, 2.2, 0)])
def test_half_turns_have_quaternions_too(vector: tuple[float, ...]) -> None:
    rotation = Rotation.from_rotvec(vector)
    found = Rotation.from_quat(np.array(QUATERNION(rotation.as_matrix())).ravel())
    assert (found * rotation.inv()).magnitude() < 1e-12


@given(rotations, rotations, st.lists(st.floats(0.1, 10), min_size=3, max_size=3))
def test_the_nearest_rotation_is_that_of_the_singular_value_decomposition(a, b, values) -> None:
    u, v = a.as_matrix(), b.as_matrix()
    found = np.array(NEAREST(u @ np.diag(values) @ v.T))
    np.testing.assert_allclose(found, u @ v.T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seen", [7, 5, 3, 2, 1])
def test_the_fit_is_the_printed_one(seen: int) -> None:
    """(E.1)–(E.6) with their matrices, solved by numpy."""
    rng = np.random.default_rng(seen)
    z = PATTERN - PATTERN.mean(axis=0)  # "the pattern origin is the geometric centre"
    prior, true = (Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix() for _ in range(2))
    y = CENTRE + z @ true.T + rng.normal(0, 1e-3, (7, 3))
    trust = 0.05
    axes = np.eye(3)
    regressor = np.vstack([np.hstack([np.eye(3), *(np.outer(axes[r], z[i]) for r in range(3))]) for i in range(7)])
    rows = rng.permutation(7)[:seen]
    knockout = np.eye(7)[rows]  # K_o
    top = np.kron(knockout, np.eye(3)) @ regressor
    regularised = np.vstack([top, np.hstack([np.zeros((9, 3)), np.eye(9)])])
    weight = np.diag([1.0] * (3 * seen) + [trust] * 9)
    measured = np.concatenate([np.kron(knockout, np.eye(3)) @ y.ravel(), prior.ravel()])
    theta = np.linalg.solve(regularised.T @ weight @ regularised, regularised.T @ weight @ measured)
    weights = np.isin(np.arange(7), rows).astype(float)
    affine, mean_z, mean_y = (np.array(m) for m in FIT(PATTERN.T, y.T, weights, prior, trust))
    np.testing.assert_allclose(affine, theta[3:].reshape(3, 3), rtol=0, atol=1e-11)
    origin = (mean_y - affine @ (mean_z - PATTERN.mean(axis=0)[:, None])).ravel()
    np.testing.assert_allclose(origin, theta[:3], rtol=0, atol=1e-11)


# --- the estimator on a torso that turns ------------------------------------------------------------------------


@cache
def attitude(t: float) -> Rotation:
    """Turns by some ten degrees at one to two hertz."""
    w = 2 * np.pi
    return Rotation.from_euler(
        "ZYX", [0.3 + 0.1 * np.sin(0.7 * w * t), 0.2 * np.sin(1.1 * w * t), 0.15 * np.sin(1.7 * w * t + 1)]
    )


@cache
def angular_velocity(t: float, step: float = 1e-5) -> np.ndarray:
    """In the base's frame, by central difference."""
    return (attitude(t - step).inv() * attitude(t + step)).as_rotvec() / (2 * step)


class Rig:
    """The estimator beside a torso that turns, with a gyro and cameras that see it."""

    def __init__(
        self, delay_s: float = 0.005, noise: float = 0.0, bias=(0.0, 0.0, 0.0), seed: int = 0, **config
    ) -> None:
        self.estimator = MotionCaptureOrientation(ROBOT, MotionCaptureFilterConfig(**config), compile_function)
        self.delay_ns = round(delay_s * 1e9)
        self.noise, self.bias = noise, np.array(bias)
        self.rng = np.random.default_rng(seed)
        self.sample = self.exposure = 0
        self.under_way: list[tuple[int, Frame]] = []
        self.hide = lambda frame: np.ones(len(SYSTEM.leds))
        self.quaternions: list[np.ndarray] = []

    def frame(self, exposure_ns: int) -> Frame:
        positions = np.zeros((len(SYSTEM.leds), 3))
        turn = attitude(exposure_ns * 1e-9).as_matrix()
        positions[BODY] = CENTRE + PATTERN @ turn.T + self.rng.normal(0, self.noise, (len(BODY), 3))
        seen = self.hide(self.exposure)
        return Frame(exposure_ns, self.exposure, seen, positions * seen[:, None])

    def run(self, seconds: float) -> np.ndarray:
        """Go on; returns the errors of the last ticks [rad] (n, 3)."""
        errors = []
        for _ in range(round(seconds * RATE)):
            now = self.sample * 10**9 // RATE
            while self.exposure * 10**9 // SYSTEM.rate <= now:
                exposed = self.exposure * 10**9 // SYSTEM.rate
                self.under_way.append((exposed + self.delay_ns, self.frame(exposed)))
                self.exposure += 1
            self.estimator.take_imu(angular_velocity(now * 1e-9) + self.bias, now)
            while self.under_way and self.under_way[0][0] <= now:
                self.estimator.take_frame(self.under_way.pop(0)[1])
            self.sample += 1
            estimate = Rotation.from_quat(self.estimator.quaternion)
            self.quaternions.append(self.estimator.quaternion.copy())
            errors.append((estimate * attitude(now * 1e-9).inv()).as_rotvec())
        return np.array(errors)


def largest(errors: np.ndarray) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


@pytest.mark.parametrize("delay_s", [0.0, 0.005, 0.03])
def test_it_finds_the_orientation_whatever_the_delay(delay_s: float) -> None:
    rig = Rig(delay_s)
    rig.run(0.5)
    assert largest(rig.run(0.5)) < 2e-5  # what integrating at 1.5 kHz costs
    assert rig.estimator.refused == 0
    np.testing.assert_allclose(rig.estimator.torso, CENTRE, atol=1e-4)


def test_without_compensation_it_lags_behind() -> None:
    rig = Rig(0.005, delay_compensated=False)
    rig.run(0.5)
    fastest = max(np.linalg.norm(angular_velocity(t)) for t in np.arange(0.5, 1.5, 0.01))
    error = largest(rig.run(1.0))
    assert 0.1 * 0.005 * fastest < error < 2 * 0.005 * fastest


@pytest.mark.parametrize(("bias_gain", "tolerance"), [(0.0, 1e-13), (1.0, 1e-5)])
def test_delayed_frames_give_what_the_same_frames_at_once_would_have_given(bias_gain: float, tolerance: float) -> None:
    """When both have had their last frame. A delay makes a difference only to when a new bias begins to count: noise of
    1 mm moves it by about 1e-4 rad/s, for 5 ms, at each frame that has not decayed."""
    late, prompt = (
        Rig(delay, noise=1e-3, bias=(0.004, -0.003, 0.002), seed=5, bias_gain=bias_gain) for delay in (0.005, 0.0)
    )
    for rig in (late, prompt):
        rig.run(1.0)
        held = rig.exposure
        rig.hide = lambda exposure, held=held: np.full(len(SYSTEM.leds), float(exposure < held))  # no more
        rig.run(0.02)
    assert late.estimator.used == prompt.estimator.used
    difference = Rotation.from_quat(late.estimator.quaternion) * Rotation.from_quat(prompt.estimator.quaternion).inv()
    assert difference.magnitude() < tolerance
    assert np.abs(late.estimator.bias - prompt.estimator.bias).max() < tolerance


def test_with_all_seen_and_no_trust_it_follows_an_orientation_that_the_gyro_does_not_know() -> None:
    rig = Rig(0.0, trust=1e-4, bias_gain=0.0, bias=(5.0, 5.0, 5.0))
    rig.run(0.2)
    assert largest(rig.run(0.2)) < 5.0 * np.sqrt(3) / SYSTEM.rate + 5.0 * np.sqrt(3) / RATE


def test_the_bias_of_the_gyro_is_found_and_bridges_an_occlusion() -> None:
    bias = np.radians([0.5, -1.0, 0.8])
    rig, source = Rig(bias=bias, bias_gain=4.0), Rig(bias=bias, bias_gain=0.0)
    for each in (rig, source):
        each.run(2.5)
    np.testing.assert_allclose(rig.estimator.bias, bias, atol=2e-4)
    np.testing.assert_allclose(rig.estimator.rate, angular_velocity((rig.sample - 1) / RATE), atol=3e-4)
    steady = np.linalg.norm(source.run(0.1)[-1])
    assert steady > 20 * np.linalg.norm(rig.run(0.1)[-1])  # a constant bias bends the source's estimate
    for each in (rig, source):
        each.hide = lambda exposure: np.zeros(len(SYSTEM.leds))
        error = largest(each.run(1.0))
        assert error < 2e-3 if each is rig else error > np.linalg.norm(bias) * 0.95


def test_it_bears_leds_that_are_hidden_in_turn() -> None:
    rig = Rig(noise=5e-4)
    chance = np.random.default_rng(1)
    rig.run(0.5)
    rig.hide = lambda exposure: (chance.random(len(SYSTEM.leds)) > 0.7).astype(float)
    assert largest(rig.run(2.0)) < 5e-3
    rig.hide = lambda exposure: (np.arange(len(SYSTEM.leds)) == 2).astype(float)  # one LED tells no orientation
    before = rig.estimator.used
    assert largest(rig.run(0.5)) < 6e-3
    assert rig.estimator.used > before and rig.estimator.refused == 0


def test_it_starts_from_any_orientation() -> None:
    for yaw in (0.0, 1.5, 3.1, -2.5):
        estimator = MotionCaptureOrientation(ROBOT, MotionCaptureFilterConfig(), compile_function)
        turn = Rotation.from_euler("ZYX", [yaw, 0.05, -0.04])
        positions = np.zeros((len(SYSTEM.leds), 3))
        positions[BODY] = CENTRE + PATTERN @ turn.as_matrix().T
        for k in range(600):
            estimator.take_imu(np.zeros(3), k * 10**9 // RATE)
            if k % 3 == 0:
                estimator.take_frame(Frame(k * 10**9 // RATE, k, np.ones(len(SYSTEM.leds)), positions))
        assert (Rotation.from_quat(estimator.quaternion) * turn.inv()).magnitude() < 1e-6


def test_hanging_tells_the_orientation_until_a_frame_does() -> None:
    rig = Rig()
    hung = Rotation.from_rotvec([0.05, -0.02, 0.4])
    for k in range(10):
        rig.estimator.hang(hung.as_quat(), np.array([0.1, 0.2, 0.3]))
        rig.estimator.take_imu(np.array([0.1, 0.2, 0.3]), k * 666_667)
    assert (Rotation.from_quat(rig.estimator.quaternion) * hung.inv()).magnitude() < 1e-12
    assert np.abs(rig.estimator.rate).max() < 1e-15


# --- frames that are not to be believed ---------------------------------------------------------------------------


def test_frames_out_of_time_or_shape_are_counted_and_change_nothing() -> None:
    rig = Rig()
    rig.run(0.5)
    estimator = rig.estimator
    now = (rig.sample - 1) * 10**9 // RATE
    state = pickle.dumps((estimator.quaternion, estimator.bias, estimator.torso, estimator.torso_ns))

    def take(frame: Frame) -> tuple[int, int]:
        late, refused = estimator.late, estimator.refused
        estimator.take_frame(frame)
        assert pickle.dumps((estimator.quaternion, estimator.bias, estimator.torso, estimator.torso_ns)) == state
        return estimator.late - late, estimator.refused - refused

    good = rig.frame(now)
    assert take(good._replace(exposure_ns=now + 3_000_000)) == (0, 1)  # from the future
    assert take(good._replace(exposure_ns=2**62)) == (0, 1)
    assert take(good._replace(exposure_ns=now - 100_000_000)) == (1, 0)  # older than what is kept
    assert take(good._replace(exposure_ns=estimator.torso_ns)) == (1, 0)  # twice
    assert take(good._replace(exposure_ns=-5)) == (1, 0)
    spoiled = good.positions.copy()
    spoiled[[1, 4]] += [[0.05, 0.02, 0.0], [0.0, -0.03, 0.06]]  # two LEDs where they cannot be
    assert take(good._replace(positions=spoiled)) == (0, 1)
    used = estimator.used
    estimator.take_frame(good)
    assert estimator.used == used + 1
    # the feet's LEDs are told on, whoever needs them
    feet = good.positions.copy()
    feet[7] = 1.0, 2.0, 3.0
    estimator.take_frame(good._replace(exposure_ns=now + 1, positions=feet))
    assert estimator.leds[7].tolist() == [1.0, 2.0, 3.0] and estimator.leds_ns[7] == now + 1


def test_an_led_that_has_come_loose_is_left_out() -> None:
    rig, loose = Rig(), Rig()
    frame = loose.frame
    off = np.zeros((len(SYSTEM.leds), 3))
    off[3] = 0.02, -0.03, 0.01
    loose.frame = lambda exposure_ns: (good := frame(exposure_ns))._replace(positions=good.positions + off)
    rig.hide = lambda exposure: (np.arange(len(SYSTEM.leds)) != 3).astype(float)
    for each in (rig, loose):
        each.run(0.4)
    assert loose.estimator.refused == 0 and loose.estimator.used == rig.estimator.used
    np.testing.assert_allclose(loose.estimator.quaternion, rig.estimator.quaternion, rtol=0, atol=1e-14)


def test_a_mirror_image_is_no_start() -> None:
    rig = Rig()
    rig.estimator.take_imu(np.zeros(3), 0)
    good = rig.frame(0)
    rig.estimator.take_frame(good._replace(positions=good.positions * [1, 1, -1]))  # it keeps all distances
    assert (rig.estimator.used, rig.estimator.refused) == (0, 1)


def test_nothing_is_taken_before_the_first_sample_of_the_gyro_or_twice() -> None:
    rig = Rig()
    rig.estimator.take_frame(rig.frame(0))
    assert rig.estimator.used == 0
    rig.run(0.1)
    before = rig.estimator.quaternion.copy()
    rig.estimator.take_imu(np.ones(3), (rig.sample - 1) * 10**9 // RATE)
    assert (rig.estimator.quaternion == before).all()


def test_a_robot_without_leds_on_its_torso_is_refused() -> None:
    feet = SYSTEM.model_copy(update={"leds": SYSTEM.leds[5:]})
    with pytest.raises(ValueError, match="2 LEDs on torso"):
        MotionCaptureOrientation(ROBOT.model_copy(update={"motion_capture": feet}), MotionCaptureFilterConfig())
    with pytest.raises(ValueError, match="no LEDs"):
        MotionCaptureOrientation(ROBOT.model_copy(update={"motion_capture": None}), MotionCaptureFilterConfig())


# --- state and cost -----------------------------------------------------------------------------------------------


def test_a_restored_estimator_continues_bit_for_bit() -> None:
    rig = Rig(noise=1e-3)
    rig.run(0.3)
    twin = Rig(noise=1e-3)
    twin.estimator.restore(pickle.loads(pickle.dumps(rig.estimator.snapshot())))
    for name in ("sample", "exposure", "rng"):
        setattr(twin, name, pickle.loads(pickle.dumps(getattr(rig, name))))
    twin.under_way = list(rig.under_way)
    assert rig.run(0.1).tobytes() == twin.run(0.1).tobytes()


def test_interpreted_and_compiled_are_the_same_to_the_bit() -> None:
    compiled, interpreted = Rig(noise=1e-3), Rig(noise=1e-3)
    interpreted.estimator = MotionCaptureOrientation(ROBOT, MotionCaptureFilterConfig())
    assert compiled.run(0.2).tobytes() == interpreted.run(0.2).tobytes()


def test_a_sample_and_a_frame_are_short() -> None:
    rig = Rig()
    rig.run(0.5)
    samples, frames = [], []
    gyro = np.zeros(3)
    for k in range(300):
        now = (rig.sample + k) * 10**9 // RATE
        start = time.perf_counter_ns()
        rig.estimator.take_imu(gyro, now)
        samples.append(time.perf_counter_ns() - start)
        frame = rig.frame(now - 5_000_000)
        start = time.perf_counter_ns()
        rig.estimator.take_frame(frame)
        frames.append(time.perf_counter_ns() - start)
    assert min(samples) < 20e3 and min(frames) < 100e3
