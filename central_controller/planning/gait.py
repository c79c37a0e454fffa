"""Is a gait stable, and with which parameters? The linear step-to-step analysis of Kim 2018 §4.3.2.

On a level surface, with X = (x, x')ᵀ at a change of the stance foot and the goal at the origin, one step is

    X⁺ = A X + B p,    A = [c, s/ω; ω s, c],  B = [1 − c; −ω s]      (4.28)–(4.30)
    p  = K X,          K = [1 + κ,  coth(ω t')/ω]                    (4.32), and (4.33) with the sign that stabilises

with c = cosh ωT, s = sinh ωT, ω² = g/h. From A' = A + B K follow, by hand,

    trace A' = 2 c + (1 + κ)(1 − c) − s coth ωt'
    det A'   = 1 + (1 + κ)(c − 1) − s coth ωt'

so any two eigenvalues can be had, and Jury's conditions for all |λ| < 1 become

    κ > 0,    t' > T/2,    (1 + κ) tanh(ωT/2) < coth(ωt')
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Gait:
    """One direction of a gait on level ground. SI units."""

    height: float  # of the centre of mass above the feet, h
    step_time: float  # T
    kappa: float  # κ, pull towards the goal
    reversal_time: float  # t'
    gravity: float = 9.81

    @property
    def omega(self) -> float:
        """ω of (4.27), 1/s."""
        return math.sqrt(self.gravity / self.height)

    @property
    def _hyperbolic(self) -> tuple[float, float, float]:
        """cosh ωT, sinh ωT, coth ωt'."""
        angle = self.omega * self.step_time
        return math.cosh(angle), math.sinh(angle), 1.0 / math.tanh(self.omega * self.reversal_time)

    def free_map(self) -> tuple[np.ndarray, np.ndarray]:
        """A (2, 2) and B (2,) of (4.29), (4.30)."""
        c, s, _ = self._hyperbolic
        w = self.omega
        return np.array([[c, s / w], [w * s, c]]), np.array([1.0 - c, -w * s])

    def feedback(self) -> np.ndarray:
        """K (2,): the foot's place from the state at the switch, goal at the origin."""
        return np.array([1.0 + self.kappa, self._hyperbolic[2] / self.omega])

    def step_map(self) -> np.ndarray:
        """A' = A + B K (2, 2)."""
        a, b = self.free_map()
        return a + np.outer(b, self.feedback())

    def eigenvalues(self) -> tuple[complex, complex]:
        """Of A', the one with the greater real part first."""
        c, s, coth = self._hyperbolic
        half = 0.5 * (2.0 * c + (1.0 + self.kappa) * (1.0 - c) - s * coth)
        root = np.emath.sqrt(half * half - (1.0 + (1.0 + self.kappa) * (c - 1.0) - s * coth))
        return half + root, half - root

    @property
    def magnitude(self) -> float:
        """The greater |λ|: what is left of a disturbance after one step."""
        return max(abs(value) for value in self.eigenvalues())

    def stable_reversal_times(self) -> tuple[float, float]:
        """Between these t' [s] the gait is stable, given T and κ > 0; the upper one may be infinite. Empty (the lower
        one is the greater) when κ is too great for this T."""
        w, half = self.omega, 0.5 * self.step_time
        bound = (1.0 + self.kappa) * math.tanh(w * half)
        return half, math.inf if bound <= 1.0 else math.atanh(1.0 / bound) / w

    def step_width(self, bias: float) -> float:
        """Lateral distance [m] between the feet in the limit cycle that a constant outward ``bias`` [m] on the planned
        foot makes: 4 b (1 + cosh ωT) / ((1 + λ1)(1 + λ2)). Great where an eigenvalue is close to −1."""
        c, s, coth = self._hyperbolic
        return 4.0 * bias * (1.0 + c) / (2.0 + 2.0 * c - 2.0 * s * coth)


def place(height: float, step_time: float, first: float, second: float, gravity: float = 9.81) -> Gait:
    """The gait with these two (real) eigenvalues. Raises ValueError when no t' gives them."""
    gait = Gait(height, step_time, 0.0, math.inf, gravity)
    c, s, _ = gait._hyperbolic
    trace, determinant = first + second, first * second
    kappa = (1.0 - trace + determinant) / (2.0 * (c - 1.0))
    coth = (2.0 * c - trace + (1.0 + kappa) * (1.0 - c)) / s
    if coth <= 1.0:
        raise ValueError(
            f"no reversal time gives the eigenvalues {first:g} and {second:g} at {height:g} m and {step_time:g} s per step"
        )
    return replace(gait, kappa=kappa, reversal_time=math.atanh(1.0 / coth) / gait.omega)


def with_magnitude(gait: Gait, magnitude: float) -> Gait:
    """``gait`` with the shortest t' that gives the greater of its eigenvalues this ``magnitude``, κ as it is. Raises
    ValueError when there is none."""
    c, s, _ = gait._hyperbolic
    k, m = 1.0 + gait.kappa, magnitude
    # trace = tr0 − u, det = det0 − u with u = s coth ωt'. λ = −m, λ = m: m² ∓ m trace + det = 0; a pair: det = m².
    tr0, det0 = 2.0 * c + k * (1.0 - c), 1.0 + k * (c - 1.0)
    candidates = [(m * m + m * tr0 + det0) / (1.0 + m), det0 - m * m]
    if m != 1.0:
        candidates.append((m * m - m * tr0 + det0) / (1.0 - m))
    for coth in sorted((u / s for u in candidates), reverse=True):  # the shortest t' first
        if coth > 1.0:
            found = replace(gait, reversal_time=math.atanh(1.0 / coth) / gait.omega)
            if abs(found.magnitude - magnitude) < 1e-9:
                return found
    raise ValueError(
        f"with kappa {gait.kappa:g} at {gait.height:g} m and {gait.step_time:g} s per step no reversal time gives a "
        f"magnitude of {magnitude:g}"
    )
