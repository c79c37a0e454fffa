"""Orientation of the torso from its gyro and the kinematics of a stance foot that lies flat (Kim 2018 §6.1).

State (6.4): q and z, quaternions of IMU and stance foot, body to world, and the gyro's bias b, in the source's sign:
what is *added* to the gyro's reading. Errors turn about the world's axes (6.10): q = exp(δφ) q̂, z = exp(δθ) ẑ,
b = b̂ + δb.

Prediction (6.5)–(6.7): q ⊗ exp((ω + b) Δt), z and b stay. With J_l the left Jacobian of the rotation by (ω + b) Δt

    F = [I 0 R[q̂] J_l Δt; 0 I 0; 0 0 I]                             exact; (6.24) has the first order, J_l = I

Observation. What the joints know is the base seen from the foot, m = z⁻¹ ⊗ q. (6.8) prints q ⊗ z⁻¹, which is that in
the passive convention (world to body) of its reference, but in the body-to-world one of Appendix A only where z is
the identity: no encoder knows it for a foot that is turned. With m the innovations, in the world's axes, are

    y₁ = log(ẑ ⊗ m ⊗ q̂⁻¹) ≈ δφ − δθ,    y₂ = log(s₂ ⊗ ẑ⁻¹) ≈ δθ,    H = [I −I 0; 0 I 0]      in place of (6.25)

s₂ (6.9) is the constant orientation of a foot that lies flat. A foot whose sensors do not all carry does not: its
variances in prediction and observation become very high, and the gyro alone leads (end of §6.1.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from central_controller.binding import Bound
from central_controller.estimation.kalman import UNKNOWN, corrected, identity, symmetric
from central_controller.rotations import compose, exponential, inverse, logarithm, rotation_matrix
from robots.quantities import Config, Gain, Radians, RadiansPerSecond

_LOOSE = 10.0  # rad/√s: how fast a foot that is not flat may turn, as a density


class OrientationNoise(Config):
    """Noises of the orientation filter: 1σ per sample, or densities per √Hz of a second's random walk."""

    gyro: Gain = 5.236e-4  # rad/s/√Hz: robots/hume.toml
    bias: Gain = 1e-5  # rad/s²/√Hz: how fast the gyro's zero wanders. ASSUMED: 0.6 mrad/s in an hour
    foot: Gain = 1e-3  # rad/√s: how a flat foot creeps. ASSUMED
    kinematics: Radians = 2e-3  # of the base seen from the foot: three to six encoders. ASSUMED
    level: Radians = 5e-3  # of the ground under the foot, and of the foot's yaw. ASSUMED
    initial_orientation: Radians = 0.02
    initial_bias: RadiansPerSecond = 0.01


def left_jacobian(rotation_vector: ca.SX) -> ca.SX:
    """J_l (3, 3): exp(a + δ) = exp(J_l(a) δ) exp(a) to the first order in δ; off by 4e-5 at a = 0.1 rad."""
    cross = ca.skew(rotation_vector)
    return ca.SX.eye(3) + cross / 2 + cross @ cross / 6


def prediction(q: ca.SX, bias: ca.SX, gyro: ca.SX, dt: ca.SX) -> tuple[ca.SX, ca.SX]:
    """q after ``dt`` [s], and the Jacobian F (9, 9) of the errors [δφ, δθ, δb]."""
    turn = (gyro + bias) * dt
    F = ca.SX.eye(9)
    F[:3, 6:] = rotation_matrix(q) @ left_jacobian(turn) * dt
    return compose(q, exponential(turn)), F


def innovation(q: ca.SX, z: ca.SX, relative: ca.SX, flat: ca.SX) -> tuple[ca.SX, ca.SX]:
    """y (6,), and its Jacobian H (6, 9) by the errors. ``relative``: the base seen from the foot, z⁻¹ ⊗ q;
    ``flat``: the orientation of a foot that lies flat, s₂."""
    y = ca.vertcat(logarithm(compose(compose(z, relative), inverse(q))), logarithm(compose(flat, inverse(z))))
    eye, none = ca.SX.eye(3), ca.SX(3, 3)
    return y, ca.blockcat([[eye, -eye, none], [none, eye, none]])


class OrientationFilter:
    """The filter at ``rate`` [Hz]. Quaternions are x, y, z, w, body to world.

    ``orientation`` (4,) of the base, ``foot`` (4,) of the stance foot, ``bias`` (3,) [rad/s] to be added to the gyro,
    ``covariance`` (9, 9) of [δφ, δθ, δb] in the world's axes, ``nis`` of the last correction (6 degrees of freedom
    while the foot is flat, 3 otherwise).
    """

    def __init__(
        self, rate: float, noise: OrientationNoise, compile: Callable[[ca.Function], ca.Function] = identity
    ) -> None:
        self._noise = noise
        self.orientation, self.foot = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0])
        self.bias = np.zeros(3)
        self.covariance = np.zeros((9, 9), order="F")
        self._reference = np.array([0.0, 0.0, 0.0, 1.0])  # s₂
        self._gyro, self._relative, self._is_flat = np.zeros(3), np.zeros(4), np.zeros(1)
        self._nis = np.zeros(1)
        self._next = [np.zeros(4), np.zeros(4), np.zeros(3), np.zeros((9, 9), order="F")]
        now = {"q": self.orientation, "z": self.foot, "b": self.bias, "P": self.covariance, "is_flat": self._is_flat}
        q, z, b, P = self._next
        after = {"q_next": q, "z_next": z, "b_next": b, "P_next": P, "nis": self._nis}
        self._predict = Bound(compile(_predict(rate, noise)), {**now, "gyro": self._gyro}, after)
        more = {"relative": self._relative, "reference": self._reference}
        self._correct = Bound(compile(_correct(noise)), {**now, **more}, after)
        self._place = Bound(_placed(), {"q": self.orientation, "relative": self._relative}, {"z": self.foot})
        self.reset(self.orientation, self.orientation)

    @property
    def nis(self) -> float:
        return float(self._nis[0])

    def reset(self, orientation: np.ndarray, relative: np.ndarray) -> None:
        """Begin with the base's ``orientation`` (4,) and a flat stance foot from which the base is seen as ``relative``
        (4,)."""
        noise = self._noise
        self.orientation[:] = orientation
        self.bias[:] = 0.0
        self.covariance[:] = np.diag(
            np.repeat([noise.initial_orientation, noise.initial_orientation, noise.initial_bias], 3) ** 2
        )
        self._nis[0] = 0.0
        self.stand_on(relative)

    def stand_on(self, relative: np.ndarray) -> None:
        """Change the stance foot: the base is seen from the new one as ``relative`` (4,). It counts as flat, with the
        yaw that follows from the estimate; an error of that yaw stays."""
        self._relative[:] = relative
        self._place()
        x, y, z, w = self.foot.tolist()
        yaw = math.atan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
        self._reference[:] = 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)
        P = self.covariance  # the foot's error is now the base's and the kinematics'
        P[3:6, :] = P[0:3, :]
        P[:, 3:6] = P[:, 0:3]
        P[3:6, 3:6] += np.eye(3) * self._noise.kinematics**2

    def predict(self, gyro: np.ndarray, flat: bool) -> None:
        """One sample period with the angular velocity ``gyro`` (3,) [rad/s] in the base's frame. ``flat``: whether all
        sensors of the stance foot carry."""
        self._gyro[:] = gyro
        self._is_flat[0] = flat
        self._predict()
        self.orientation[:] = self._next[0]
        self.covariance[:] = self._next[3]

    def correct(self, relative: np.ndarray, flat: bool) -> None:
        """Take from the joints how the base is seen from the stance foot, ``relative`` (4,)."""
        self._relative[:] = relative
        self._is_flat[0] = flat
        self._correct()
        self.orientation[:], self.foot[:], self.bias[:], self.covariance[:] = self._next

    _ARRAYS = ("orientation", "foot", "bias", "covariance", "_reference", "_nis")

    def snapshot(self) -> Any:
        return [getattr(self, name).copy() for name in self._ARRAYS]

    def restore(self, state: Any) -> None:
        for name, value in zip(self._ARRAYS, state, strict=True):
            getattr(self, name)[:] = value


def _placed() -> ca.Function:
    q, relative = ca.SX.sym("q", 4), ca.SX.sym("relative", 4)
    return ca.Function("placed", [q, relative], [compose(q, inverse(relative))], ["q", "relative"], ["z"])


def _predict(rate: float, noise: OrientationNoise) -> ca.Function:
    q, b, P = ca.SX.sym("q", 4), ca.SX.sym("b", 3), ca.SX.sym("P", 9, 9)
    gyro, is_flat = ca.SX.sym("gyro", 3), ca.SX.sym("is_flat")
    dt = 1.0 / rate
    after, F = prediction(q, b, gyro, ca.SX(dt))
    foot = ca.if_else(is_flat, noise.foot, _LOOSE)
    # L_c turns the gyro's noise into the world's axes: of three alike, that changes nothing
    Q = ca.diag(ca.vertcat(*[noise.gyro**2] * 3, *[foot**2] * 3, *[noise.bias**2] * 3)) * dt
    return ca.Function(
        "orientation_predict",
        [q, b, P, gyro, is_flat],
        [after, ca.densify(symmetric(F @ (P + Q) @ F.T))],
        ["q", "b", "P", "gyro", "is_flat"],
        ["q_next", "P_next"],
    )


def _correct(noise: OrientationNoise) -> ca.Function:
    q, z, b, P = ca.SX.sym("q", 4), ca.SX.sym("z", 4), ca.SX.sym("b", 3), ca.SX.sym("P", 9, 9)
    relative, reference, is_flat = ca.SX.sym("relative", 4), ca.SX.sym("reference", 4), ca.SX.sym("is_flat")
    y, H = innovation(q, z, relative, reference)
    level = ca.if_else(is_flat, noise.level**2, UNKNOWN)
    variances = ca.vertcat(*[ca.SX(noise.kinematics**2)] * 3, *[level] * 3)
    change, after, nis = corrected(P, H, variances, y)
    return ca.Function(
        "orientation_correct",
        [q, z, b, P, relative, reference, is_flat],
        [
            compose(exponential(change[:3]), q), compose(exponential(change[3:6]), z), b + change[6:],
            ca.densify(after), nis,
        ],
        ["q", "z", "b", "P", "relative", "reference", "is_flat"],
        ["q_next", "z_next", "b_next", "P_next", "nis"],
    )  # fmt: skip
