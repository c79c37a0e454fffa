"""Orientation of the torso from motion capture that comes late and partly hidden, and a gyro that drifts
(Kim 2018, Appendix E).

Between frames the gyro is integrated: D ← D exp((ω − b) Δt), on the right, as ω is the base's (in (E.7) the increment
lacks its factor A). A frame shows the LEDs as they were at its exposure k, some milliseconds ago. The affine map
y = x + A z from the LEDs' pattern z to what was seen, drawn to the predicted orientation Ã by λ, is (E.1)–(E.6):

    min Σ |yᵢ − x − A zᵢ|² + λ ‖A − Ã‖²    over the LEDs seen
    A = (Σ Δy Δzᵀ + λ Ã) (Σ Δz Δzᵀ + λ I)⁻¹,  Δ: about the mean of those seen

and the rotation nearest to A is the estimate Q at k. What has been integrated since is put on top of it (Fig. E.2). No
sum has to be done again for that: with D kept for some time, the orientation now is Q Dₖ⁻¹ D, so a frame changes one
factor, C = Q Dₖ⁻¹, and C D is the orientation, whenever the exposure was.

Beside the source: the turn that frames bring, again and again in one direction, tells the gyro's bias b.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from central_controller.binding import Bound
from central_controller.config import MotionCaptureFilterConfig
from central_controller.rotations import (
    compose,
    exponential,
    inverse,
    logarithm,
    nearest_rotation,
    quaternion_of,
    rotation_matrix,
)
from robots.description import Robot
from robots.motion_capture import Frame

_KEPT = 128  # samples of the gyro: 85 ms at 1.5 kHz, and frames older than that are ignored
_AHEAD_NS = 2_000_000  # a frame exposed so long after the last sample of the gyro was not timed by this clock
_FIRST_TRUST = 0.01  # m²: λ of the first frame; it grows by that with each up to its full value
_LEAST_DETERMINANT = 0.1  # of A: a rotation's is 1, a reflection's −1


# What it tells of itself, beside the orientation.
FIELDS = ("gyro_bias.x", "gyro_bias.y", "gyro_bias.z", "frames_used", "frames_late", "frames_refused")


def advance() -> ca.Function:
    """One sample of the gyro. Inputs: integrated (4), correction (4), gyro now and before (3), bias (3) [rad/s],
    length [s]. Outputs: integrated_next, mean rate over the sample (3), rate now (3), quaternion."""
    integrated, correction = ca.SX.sym("integrated", 4), ca.SX.sym("correction", 4)
    gyro, before, bias = (ca.SX.sym(name, 3) for name in ("gyro", "before", "bias"))
    length = ca.SX.sym("length")
    mean = (gyro + before) / 2 - bias
    after = compose(integrated, exponential(mean * length))
    return ca.Function(
        "motion_capture_advance",
        [integrated, correction, gyro, before, bias, length],
        [after, mean, gyro - bias, compose(correction, after)],
        ["integrated", "correction", "gyro", "before", "bias", "length"],
        ["integrated_next", "mean", "rate", "quaternion"],
    )


def affine_fit(pattern: ca.SX, positions: ca.SX, weights: ca.SX, prior: ca.SX, trust: ca.SX) -> tuple[ca.SX, ...]:
    """A of (E.6), and the means of pattern and positions, both (3, n), over the points of weight 1; ``trust`` is λ."""
    count = ca.fmax(ca.sum1(weights), 1)
    z, y = pattern @ weights / count, positions @ weights / count
    each = ca.repmat(weights.T, 3, 1)
    dz, dy = each * (pattern - ca.repmat(z, 1, pattern.shape[1])), positions - ca.repmat(y, 1, pattern.shape[1])
    return (dy @ dz.T + trust * prior) @ ca.inv_minor(dz @ dz.T + trust * ca.SX.eye(3)), z, y


def without_the_worst(pattern: np.ndarray, positions: ca.SX, weights: ca.SX, gate: ca.SX) -> tuple[ca.SX, ca.SX]:
    """``weights`` (n) without one point whose distances are not those of ``pattern`` (3, n), and the greatest error of
    a distance [m] that is left. Distances tell it whatever the orientation is."""
    n = pattern.shape[1]
    errors = ca.SX.zeros(n, n)
    for i, j in itertools.combinations(range(n), 2):
        distance = ca.norm_2(positions[:, i] - positions[:, j])
        errors[i, j] = errors[j, i] = ca.fabs(distance - float(np.linalg.norm(pattern[:, i] - pattern[:, j])))
    wrong = ca.sum1((weights @ weights.T) * errors > gate).T  # how many of each point's distances are
    most = ca.mmax(wrong)
    weights = weights * ca.logic_or(most == 0, wrong < most)
    return weights, ca.mmax((weights @ weights.T) * errors)


def correct(pattern: np.ndarray) -> ca.Function:
    """One frame of the LEDs at ``pattern`` (3, n) in the base's frame.

    Inputs: positions (3, n) [m], weights (n; 1: seen), what was integrated at the sample before the exposure (4), rate
    from there on (3), time from there [s], correction (4), bias (3), trust: λ [m²], gain of the bias [1/s], gate [m].
    Outputs: correction_next, bias_next, position of the torso at the exposure (3), count of LEDs that have gone in,
    distortion [m] (the greatest error of a distance between two of those), determinant of A.
    """
    n = pattern.shape[1]
    positions, weights = ca.SX.sym("positions", 3, n), ca.SX.sym("weights", n)
    integrated, rate, since = ca.SX.sym("integrated", 4), ca.SX.sym("rate", 3), ca.SX.sym("since")
    correction, bias = ca.SX.sym("correction", 4), ca.SX.sym("bias", 3)
    trust, bias_gain, gate = ca.SX.sym("trust"), ca.SX.sym("bias_gain"), ca.SX.sym("gate")
    exposed = compose(integrated, exponential(rate * since))
    prior = compose(correction, exposed)
    used, distortion = without_the_worst(pattern, positions, weights, gate)
    affine, z, y = affine_fit(ca.SX(pattern), positions, used, rotation_matrix(prior), trust)
    rotation = nearest_rotation(affine)
    quaternion = quaternion_of(rotation)
    turn = logarithm(compose(inverse(prior), quaternion))  # in the base's frame
    return ca.Function(
        "motion_capture_correct",
        [positions, weights, integrated, rate, since, correction, bias, trust, bias_gain, gate],
        [
            compose(quaternion, inverse(exposed)), bias - bias_gain * turn, y - rotation @ z,
            ca.sum1(used), distortion, ca.det(affine),
        ],
        ["positions", "weights", "integrated", "rate", "since", "correction", "bias", "trust", "bias_gain", "gate"],
        ["correction_next", "bias_next", "position", "count", "distortion", "determinant"],
    )  # fmt: skip


def _identity(function: ca.Function) -> ca.Function:
    return function


class MotionCaptureOrientation:
    """The estimator. Times are the controller's clock, ns; so are the frames' exposures.

    ``quaternion`` (x, y, z, w; base to world) and ``rate`` (3) [rad/s, base's frame] are those of the last sample of
    the gyro, ``bias`` (3) [rad/s] is the gyro's. ``torso`` (3) [m] is where the base's frame was at ``torso_ns``, and
    ``leds`` (n, 3) [m] where each LED was when it was last seen, at ``leds_ns``; -1: never.

    Raises ValueError for a robot without motion capture, or with fewer than three LEDs on its base.
    """

    def __init__(
        self,
        robot: Robot,
        config: MotionCaptureFilterConfig,
        compile: Callable[[ca.Function], ca.Function] = _identity,
    ) -> None:
        if robot.motion_capture is None:
            raise ValueError(f"{robot.name} has no LEDs for motion capture")
        leds = robot.motion_capture.leds
        self._body = np.array([i for i, led in enumerate(leds) if led.link == robot.base.name])
        n = len(self._body)
        if n < 3:
            raise ValueError(f"{robot.name} has {n} LEDs on {robot.base.name}: its orientation needs 3")
        self._config = config

        self.quaternion, self.rate, self.bias = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3)
        self.torso, self.torso_ns = np.zeros(3), -1
        self.leds, self.leds_ns = np.zeros((len(leds), 3)), [-1] * len(leds)
        self.telemetry = np.zeros(len(FIELDS))
        self.used = 0  # frames that have corrected the orientation
        self.late = 0  # frames older than one that was used, or than what is kept
        self.refused = 0  # frames of another clock, or with more than one LED where it cannot be

        self._integrated, self._after = self.quaternion.copy(), np.zeros(4)
        self._correction, self._correction_next = self.quaternion.copy(), np.zeros(4)
        self._gyro, self._before, self._length = np.zeros(3), np.zeros(3), np.zeros(1)
        self._mean, self._bias_next, self._position = np.zeros(3), np.zeros(3), np.zeros(3)
        self._positions, self._weights = np.zeros((3, n), order="F"), np.zeros(n)
        self._exposed, self._exposed_rate, self._since = np.zeros(4), np.zeros(3), np.zeros(1)
        self._trust, self._bias_gain, self._count = np.zeros(1), np.zeros(1), np.zeros(1)
        self._distortion, self._determinant = np.zeros(1), np.zeros(1)
        # the samples kept, in a ring: time, what was integrated by then, and at which rate to there
        self._times = [-1] * _KEPT
        self._history, self._rates = np.zeros((_KEPT, 4)), np.zeros((_KEPT, 3))
        self._newest = -1  # none
        self._advance = Bound(
            compile(advance()),
            {
                "integrated": self._integrated, "correction": self._correction, "gyro": self._gyro,
                "before": self._before, "bias": self.bias, "length": self._length,
            },
            {
                "integrated_next": self._after, "mean": self._mean, "rate": self.rate, "quaternion": self.quaternion,
            },
        )  # fmt: skip
        self._correct = Bound(
            compile(correct(np.array([leds[i].position for i in self._body]).T)),
            {
                "positions": self._positions, "weights": self._weights, "integrated": self._exposed,
                "rate": self._exposed_rate, "since": self._since, "correction": self._correction, "bias": self.bias,
                "trust": self._trust, "bias_gain": self._bias_gain, "gate": np.array([config.gate]),
            },
            {
                "correction_next": self._correction_next, "bias_next": self._bias_next, "position": self._position,
                "count": self._count, "distortion": self._distortion, "determinant": self._determinant,
            },
        )  # fmt: skip

    def hang(self, quaternion: np.ndarray, zero: np.ndarray) -> None:
        """The robot hangs still: its orientation, used where no frame has told it yet, and the gyro's bias [rad/s]."""
        self.bias[:] = zero
        if not self.used:
            self._correction[:] = quaternion
            self._integrated[:] = 0.0, 0.0, 0.0, 1.0

    def take_imu(self, gyro: np.ndarray, time_ns: int) -> None:
        """Go on to a sample of the gyro [rad/s], base's frame. One that is not later than the last changes nothing."""
        newest = self._newest
        if newest < 0:
            self._before[:] = gyro
            self._length[0] = 0.0
        elif time_ns <= self._times[newest]:
            return
        else:
            self._length[0] = (time_ns - self._times[newest]) * 1e-9
        self._gyro[:] = gyro
        self._advance()
        self._integrated[:] = self._after
        self._before[:] = gyro
        self._newest = newest = (newest + 1) % _KEPT
        self._times[newest] = time_ns
        self._history[newest], self._rates[newest] = self._after, self._mean

    def take_frame(self, frame: Frame) -> None:
        """Correct the orientation by what the cameras saw, at the time when they saw it."""
        if self._newest < 0:
            return
        now_ns = self._times[self._newest]
        if frame.exposure_ns > now_ns + _AHEAD_NS:
            self.refused += 1
            return
        exposure_ns = frame.exposure_ns if self._config.delay_compensated else now_ns
        if exposure_ns <= self.torso_ns or not self._look_up(exposure_ns):
            self.late += 1
            return
        self._weights[:] = frame.seen[self._body]
        self._positions.T[:] = frame.positions[self._body]
        self._trust[0] = trust = min(self._config.trust, (self.used + 1) * _FIRST_TRUST)
        self._bias_gain[0] = self._config.bias_gain if trust == self._config.trust else 0.0
        self._correct()
        if self._distortion[0] > self._config.gate or not self._determinant[0] > _LEAST_DETERMINANT:
            self.refused += 1
            return
        for i in np.flatnonzero(frame.seen).tolist():
            self.leds[i] = frame.positions[i]
            self.leds_ns[i] = frame.exposure_ns
        if self._count[0]:
            self.used += 1
            self.torso[:], self.torso_ns = self._position, exposure_ns
            self._correction[:], self.bias[:] = self._correction_next, self._bias_next
            self._length[0] = 0.0
            self._advance()  # the orientation now

    def tell(self) -> None:
        """Fill ``telemetry``, which has the meanings of FIELDS."""
        self.telemetry[:3] = self.bias
        self.telemetry[3:] = self.used, self.late, self.refused

    def _look_up(self, exposure_ns: int) -> bool:
        """Find what was integrated by the exposure. False when that is no longer kept."""
        times, at = self._times, self._newest
        for _ in range(_KEPT):
            if 0 <= times[at] <= exposure_ns:
                break
            at = at - 1 if at else _KEPT - 1
        else:
            return False
        after = at if at == self._newest else (at + 1) % _KEPT
        self._exposed[:], self._exposed_rate[:] = self._history[at], self._rates[after]
        self._since[0] = (exposure_ns - times[at]) * 1e-9
        return True

    _PLAIN = ("torso_ns", "used", "late", "refused", "_newest")
    _LISTS = ("leds_ns", "_times")
    _ARRAYS = (
        "quaternion", "rate", "bias", "torso", "leds", "_integrated", "_correction", "_gyro", "_before", "_history",
        "_rates", "telemetry",
    )  # fmt: skip  # all else is computed anew

    def snapshot(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            **{name: getattr(self, name).copy() for name in (*self._LISTS, *self._ARRAYS)},
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        for name in (*self._LISTS, *self._ARRAYS):
            getattr(self, name)[:] = state[name]  # in place: the compiled functions are bound to the arrays
