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


def quaternion_of(rotation: ca.SX) -> ca.SX:
    """Unit quaternion of a rotation matrix (3, 3), by the greatest of its elements (Shepperd 1978)."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    turn = ca.vertcat(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    best, largest = ca.vertcat(turn, 1 + trace), trace  # the quaternion, times four of its elements
    for i in range(3):
        vector = [1 - trace + 2 * m[i, i] if i == k else m[i, k] + m[k, i] for k in range(3)]
        best = ca.if_else(m[i, i] > largest, ca.vertcat(*vector, turn[i]), best)
        largest = ca.fmax(largest, m[i, i])
    return best / ca.sqrt(ca.dot(best, best))


def nearest_rotation(matrix: ca.SX) -> ca.SX:
    """The rotation (3, 3) nearest to ``matrix``, of a determinant above 0, in the sum of squares of the elements.

    By Newton's iteration for the polar decomposition, X ← (X + X⁻ᵀ) / 2 (Higham 1986): it converges quadratically, and
    needs no library that rounds differently on each processor. Singular values from 0.1 to 10 need no more than its
    eight steps.
    """
    x = matrix
    for _ in range(8):
        a, b, c = ca.horzsplit(x)
        cofactors = ca.horzcat(ca.cross(b, c), ca.cross(c, a), ca.cross(a, b))
        x = (x + cofactors / ca.dot(a, cofactors[:, 0])) / 2
    return x


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
