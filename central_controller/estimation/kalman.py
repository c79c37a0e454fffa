"""Extended Kalman filters as compiled CasADi functions on arrays that stay where they are.

The measurements' noises are independent, so a correction takes them one by one: each is a division in place of a share
of a matrix inversion, and the result is the same. Kim 2018 (6.2), (6.3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from central_controller.binding import Bound

UNKNOWN = 1e6  # variance of a measurement that is not there, in its unit's square: the on-line adjustment


def identity(function: ca.Function) -> ca.Function:
    return function


def symmetric(matrix: ca.SX) -> ca.SX:
    """``matrix`` with its lower triangle the mirror of the upper: rounding must not make a covariance lopsided."""
    return ca.triu2symm(ca.triu(matrix))


def corrected(P: ca.SX, H: ca.SX, variances: ca.SX, innovation: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Change of the state (n,), covariance (n, n) and normalised innovation squared ỹᵀ S⁻¹ ỹ after measurements with
    the Jacobian ``H`` (m, n), independent noises of ``variances`` (m,) and the ``innovation`` (m,)."""
    change, nis = ca.SX.zeros(P.size1()), ca.SX(0)
    for i in range(H.size1()):
        row = H[i, :]
        ph = P @ row.T
        s = row @ ph + variances[i]
        rest = innovation[i] - row @ change  # what the measurements before have left of it
        nis += rest * rest / s
        change += ph * (rest / s)
        P = symmetric(P - ph @ (ph / s).T)
    return change, P, nis


class ExtendedKalmanFilter:
    """x⁺ = f(x, u, Δt) + w, z = h(x) + v, with Jacobians by CasADi.

    ``x`` (n,), ``u`` (k,), ``dt`` are symbols, ``f`` (n,), ``h`` (m,) and the covariance ``Q`` (n, n) of w expressions
    of them (h of x alone). ``state`` (n,) and ``covariance`` (n, n) are the estimate; ``nis`` of the last correction
    is a chi-square number with as many degrees of freedom as there were measurements, when the filter is consistent.
    """

    def __init__(
        self, name: str, x: ca.SX, u: ca.SX, dt: ca.SX, f: ca.SX, h: ca.SX, Q: ca.SX,
        compile: Callable[[ca.Function], ca.Function] = identity,
    ) -> None:  # fmt: skip
        n, m = x.numel(), h.numel()
        P, z, r = ca.SX.sym("P", n, n), ca.SX.sym("z", m), ca.SX.sym("r", m)
        F = ca.jacobian(f, x)
        predicted = ca.densify(symmetric(F @ P @ F.T + Q))
        change, after, nis = corrected(P, ca.jacobian(h, x), r, z - h)
        prediction = ca.Function(
            f"{name}_predict", [x, P, u, dt], [ca.densify(f), predicted], ["x", "P", "u", "dt"], ["x_next", "P_next"]
        )
        correction = ca.Function(
            f"{name}_correct", [x, P, z, r], [x + change, ca.densify(after), nis], ["x", "P", "z", "r"],
            ["x_next", "P_next", "nis"],
        )  # fmt: skip
        self.state, self.covariance = np.zeros(n), np.zeros((n, n), order="F")
        self._state_next, self._covariance_next = np.zeros(n), np.zeros((n, n), order="F")
        self._u, self._dt, self._z, self._r = np.zeros(u.numel()), np.zeros(1), np.zeros(m), np.zeros(m)
        self._nis = np.zeros(1)
        now = {"x": self.state, "P": self.covariance}
        after_it = {"x_next": self._state_next, "P_next": self._covariance_next, "nis": self._nis}
        self._predict = Bound(compile(prediction), {**now, "u": self._u, "dt": self._dt}, after_it)
        self._correct = Bound(compile(correction), {**now, "z": self._z, "r": self._r}, after_it)

    @property
    def nis(self) -> float:
        return float(self._nis[0])

    def predict(self, dt: float, u: np.ndarray) -> None:
        """Go on by ``dt`` [s] with the input ``u`` (k,)."""
        self._dt[0] = dt
        self._u[:] = u
        self._predict()
        self._take()

    def correct(self, z: np.ndarray, variances: np.ndarray) -> None:
        """Take the measurements ``z`` (m,) with noises of ``variances`` (m,); UNKNOWN: it is not there."""
        self._z[:] = z
        self._r[:] = variances
        self._correct()
        self._take()

    def _take(self) -> None:
        self.state[:] = self._state_next
        self.covariance[:] = self._covariance_next

    def snapshot(self) -> Any:
        return self.state.copy(), self.covariance.copy(), self.nis

    def restore(self, state: Any) -> None:
        self.state[:], self.covariance[:], self._nis[0] = state
