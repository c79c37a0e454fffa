"""Horizontal position and velocity of the centre of mass for a planner: an observer with the inverted pendulum's model.

A point-foot biped in single support falls like a pendulum about its stance foot (Kim 2018 (4.26)). The velocity that
kinematics and gyro give is noisy; what the planner reads is "filtered by a steady state PIP model based observer" and
"not fed back by the WBOSC implementation" (Kim 2018 §7.2.2). Forward and lateral motion are the same model, so one
steady-state Kalman gain, from the stated noises, serves both axes.

    observer = PendulumObserver(height, rate, PendulumNoise())
    observer.reset(x, y, vx, vy)          # when single support begins for the first time
    observer.predict(foot_x, foot_y)      # once a tick: where the ground carries the robot
    observer.correct(x, y, vx, vy)        # what kinematics says now
    observer.shift(dx, dy)                # when the coordinates' origin moves, as to another stance foot

Feed it velocities that are not low-passed: a filter in front adds a lag of which the model knows nothing.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_discrete_are

from robots.quantities import Config, Gain, Metres, MetresPerSecond


class PendulumNoise(Config):
    """1σ of what disturbs the observer, per sample and axis.

    ``position``: centre of mass relative to the stance foot; 2 mm, ten spring-encoder counts at a leg's length.
    ``velocity``: of the same; 5 cm/s: a spring-encoder count of Hume's hip is 1.7e-4 rad, which differenced at 3 kHz
    and filtered at 200 Hz is 0.06 rad/s (1σ) on a lever of 0.8 m, when the counts come at random.
    ``disturbance`` [m/s²/√Hz]: acceleration that the pendulum does not know, as a white density: about 0.5 m/s² for
    0.05 s while a leg of 3.2 kg swings, √(2 · 0.05) · 0.5 = 0.16. ASSUMED.
    """

    position: Metres = 0.002
    velocity: MetresPerSecond = 0.05
    disturbance: Gain = 0.15


def transition(frequency: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """A (2, 2) and B (2,) of [position, velocity] after ``dt`` [s] with the foot at rest: Kim 2018 (4.28)–(4.30).
    ``frequency`` is ω = √(g/h) [rad/s]."""
    c, s = math.cosh(frequency * dt), math.sinh(frequency * dt)
    return np.array([[c, s / frequency], [frequency * s, c]]), np.array([1.0 - c, -frequency * s])


def steady_state(frequency: float, dt: float, noise: PendulumNoise) -> tuple[np.ndarray, np.ndarray]:
    """Steady-state Kalman gain (2, 2) of a measured [position, velocity], and the covariance (2, 2) of the error after
    the correction [m², m²/s, m²/s²]. Raises ValueError when a noise is not positive."""
    if min(noise.position, noise.velocity, noise.disturbance) <= 0.0:
        raise ValueError("the noises of the pendulum observer must be positive: they decide its gain")
    A, _ = transition(frequency, dt)
    Q = noise.disturbance**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])  # ω dt is small: of a point mass
    R = np.diag([noise.position**2, noise.velocity**2])
    P = solve_discrete_are(A.T, np.eye(2), Q, R)  # before the correction
    gain = np.linalg.solve(P + R, P).T
    return gain, (np.eye(2) - gain) @ P


class PendulumObserver:
    """State ``x``, ``y`` [m], ``vx``, ``vy`` [m/s] of the centre of mass, in the coordinates of its corrections.

    ``height``: of the centre of mass above the stance foot [m]; ``rate``: of ``predict`` and ``correct`` [Hz].
    ``deviation``: (position [m], velocity [m/s]), 1σ of the error that the noises let remain.
    """

    def __init__(self, height: float, rate: float, noise: PendulumNoise, gravity: float = 9.81) -> None:
        if not (height > 0.0 and rate > 0.0):
            raise ValueError(f"a pendulum needs a height and a rate above 0, not {height:g} m and {rate:g} Hz")
        frequency = math.sqrt(gravity / height)
        A, _ = transition(frequency, 1.0 / rate)
        gain, covariance = steady_state(frequency, 1.0 / rate, noise)
        self.x = self.y = self.vx = self.vy = 0.0
        self.deviation = math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])
        (self._pp, self._pv), (self._vp, self._vv) = A.tolist()
        (self._kpp, self._kpv), (self._kvp, self._kvv) = gain.tolist()

    def reset(self, x: float, y: float, vx: float, vy: float) -> None:
        """Begin anew at this position [m] and velocity [m/s]."""
        self.x, self.y, self.vx, self.vy = x, y, vx, vy

    def predict(self, foot_x: float, foot_y: float) -> None:
        """One sample period with the ground's force from this point [m]: the stance foot, or in double support the
        point between the feet that divides their distance as the weight is shared."""
        x, y, vx, vy = self.x - foot_x, self.y - foot_y, self.vx, self.vy  # 1 − cosh, −ω sinh: relative to the foot
        self.x = foot_x + self._pp * x + self._pv * vx
        self.y = foot_y + self._pp * y + self._pv * vy
        self.vx = self._vp * x + self._vv * vx
        self.vy = self._vp * y + self._vv * vy

    def correct(self, x: float, y: float, vx: float, vy: float) -> None:
        """Take what kinematics and IMU say: position [m] and velocity [m/s]."""
        x, y, vx, vy = x - self.x, y - self.y, vx - self.vx, vy - self.vy
        self.x += self._kpp * x + self._kpv * vx
        self.y += self._kpp * y + self._kpv * vy
        self.vx += self._kvp * x + self._kvv * vx
        self.vy += self._kvp * y + self._kvv * vy

    def shift(self, dx: float, dy: float) -> None:
        """The origin of the coordinates has moved by (dx, dy) [m]; a foot's change alone needs nothing of the kind."""
        self.x -= dx
        self.y -= dy

    def snapshot(self) -> tuple[float, float, float, float]:
        return self.x, self.y, self.vx, self.vy

    def restore(self, state: tuple[float, float, float, float]) -> None:
        self.x, self.y, self.vx, self.vy = state
