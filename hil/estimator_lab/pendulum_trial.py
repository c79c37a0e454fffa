"""The planner's pendulum observer on a pendulum that steps in place, with sensor noise as its configuration states."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from central_controller.estimation.pendulum_observer import PendulumNoise, PendulumObserver, transition
from hil.streams import streams

HEIGHT, RATE, GRAVITY = 0.85, 1500.0, 9.81  # m, Hz, m/s²
STEP = 0.32  # s, after which an undisturbed velocity is the opposite one (Kim 2018 Table 7.2: swing and transitions)
_SWING_ACCELERATION = 0.8  # m/s², of the pendulum when a leg swings: the leg's reaction, which no pendulum knows
_SETTLED = 0.5  # s

DISTURBANCES = ("white", "swing leg")


class Motion(NamedTuple):
    """A row per sample: true [x, y, vx, vy], the stance foot [x, y], and what the sensors said of the truth."""

    truth: np.ndarray
    feet: np.ndarray
    sensed: np.ndarray


class Errors(NamedTuple):
    """RMS of both axes together: velocity as sensed and as estimated [m/s], and what the observer expects of its own;
    the same of the position [m]."""

    sensed_velocity: float
    velocity: float
    expected_velocity: float
    sensed_position: float
    position: float
    expected_position: float


def motion(seed: int, duration: float, noise: PendulumNoise, disturbance: str) -> Motion:
    """``duration`` seconds of stepping. ``disturbance``: "white", as the noise states, or the half sines of a "swing
    leg", forth and back within a step."""
    draw = streams(seed)
    push, sensors = draw("pendulum.disturbance"), draw("pendulum.sensors")
    ticks, dt, frequency = round(duration * RATE), 1.0 / RATE, math.sqrt(GRAVITY / HEIGHT)
    A, B = transition(frequency, dt)
    reach = 1.0 / (frequency * math.tanh(frequency * STEP / 2))  # from the centre of mass, of what reverses a velocity
    truth, feet, sensed = np.zeros((ticks, 4)), np.zeros((ticks, 2)), np.zeros((ticks, 4))
    deviations = np.repeat([noise.position, noise.velocity], 2)
    state, foot, samples = np.array([0.0, 0.0, 0.2, 0.3]), np.zeros(2), round(STEP * RATE)
    for k in range(ticks):
        if k % samples == 0:
            foot = state[:2] + reach * state[2:]
        if disturbance == "white":
            kick = noise.disturbance * math.sqrt(dt) * push.normal(2)
        else:
            kick = np.full(2, _SWING_ACCELERATION * math.sin(2 * math.pi * (k % samples) / samples) * dt)
        for axis in range(2):
            state[axis::2] = A @ state[axis::2] + B * foot[axis] + np.array([dt / 2, 1.0]) * kick[axis]
        truth[k], feet[k], sensed[k] = state, foot, state + deviations * sensors.normal(4)
    return Motion(truth, feet, sensed)


def observe(motion: Motion, noise: PendulumNoise) -> Errors:
    """Run the observer over ``motion``, and compare."""
    observer = PendulumObserver(HEIGHT, RATE, noise, GRAVITY)
    observer.reset(*motion.sensed[0].tolist())
    estimates = np.zeros_like(motion.truth)
    for k, (foot, sensed) in enumerate(zip(motion.feet.tolist(), motion.sensed.tolist(), strict=True)):
        observer.predict(*foot)
        observer.correct(*sensed)
        estimates[k] = observer.snapshot()
    settled = round(_SETTLED * RATE)
    raw, left = (np.sqrt(np.mean((what - motion.truth)[settled:] ** 2, axis=0)) for what in (motion.sensed, estimates))
    position, velocity = observer.deviation
    pairs = ((raw[2:], left[2:], velocity), (raw[:2], left[:2], position))
    numbers = [(float(np.sqrt(np.mean(a**2))), float(np.sqrt(np.mean(b**2))), expected) for a, b, expected in pairs]
    return Errors(*numbers[0], *numbers[1])


def velocity_off(foot_off: float, noise: PendulumNoise) -> float:
    """Where the velocity [m/s] of a pendulum at rest settles when the stance foot is taken to be ``foot_off`` [m] ahead
    of where it is, as when a shank bends."""
    observer = PendulumObserver(HEIGHT, RATE, noise, GRAVITY)
    for _ in range(round(2.0 * RATE)):
        observer.predict(foot_off, 0.0)
        observer.correct(0.0, 0.0, 0.0, 0.0)
    return observer.vx
