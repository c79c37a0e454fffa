"""Rotations as CasADi expressions; quaternions are x, y, z, w and turn the body's axes into the world's."""

from __future__ import annotations

import casadi as ca


def rotation_matrix(quaternion: ca.SX) -> ca.SX:
    """Matrix (3, 3) of a unit quaternion."""
    x, y, z, w = ca.vertsplit(quaternion)
    return ca.blockcat([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def compose(a: ca.SX, b: ca.SX) -> ca.SX:
    """Quaternion of the rotation ``a`` after ``b``, normalised: rounding must not add up over ticks."""
    vector = a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3])
    product = ca.vertcat(vector, a[3] * b[3] - ca.dot(a[:3], b[:3]))
    return product / ca.sqrt(ca.dot(product, product))


def exponential(rotation_vector: ca.SX) -> ca.SX:
    """Quaternion of the rotation by ``rotation_vector`` [rad] (3,)."""
    half = rotation_vector / 2
    angle = ca.sqrt(ca.dot(half, half) + 1e-300)  # never 0: sin(angle)/angle is 1 there
    return ca.vertcat(ca.sin(angle) / angle * half, ca.cos(angle))


def inverse(quaternion: ca.SX) -> ca.SX:
    """The opposite rotation."""
    return ca.vertcat(-quaternion[:3], quaternion[3])


def logarithm(quaternion: ca.SX) -> ca.SX:
    """Rotation vector [rad] (3,), no longer than π, of a unit quaternion: the inverse of ``exponential``."""
    vector = ca.if_else(quaternion[3] < 0, -quaternion[:3], quaternion[:3])
    size = ca.sqrt(ca.dot(vector, vector) + 1e-300)  # never 0: atan2(size, 1)/size is 1 there
    return 2 * ca.atan2(size, ca.fabs(quaternion[3])) / size * vector
