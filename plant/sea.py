"""Series elastic actuators: rotors, springs and friction of all joints, one physics step at a time.

Everything is seen from the joint: a rotor of inertia J at angle theta drives the joint at q through a spring,

    tau_s = k (theta − q) + d (dtheta − dq),      J ddtheta = tau_m − tau_s − b dtheta − friction

The step is semi-implicit Euler, as MuJoCo's: the spring's torque at the start of the step acts on both sides,
so the coupled oscillation neither gains nor loses energy by itself. Dry friction is set-valued and implicit:
a rotor at rest stays exactly there up to the static level; a sliding one is slowed, never reversed, by the
friction of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from robots.description import Robot

STRIBECK_VELOCITY = 0.02  # rad/s at the joint: friction falls from static to sliding over this


def _sign(value: ca.SX) -> ca.SX:
    return ca.if_else(value > 0, 1, ca.if_else(value < 0, -1, 0))


def rotor_step(n: int, dt: float) -> ca.Function:
    """One step of ``n`` actuators: ``(rotor[2n], current[n], joint[2n], p[n, 9]) -> (rotor[2n], torque[n])``.

    ``rotor`` and ``joint`` are angles, then velocities; ``torque`` acts on the joint.
    """
    rotor, current = ca.SX.sym("rotor", 2 * n), ca.SX.sym("current", n)
    joint, p = ca.SX.sym("joint", 2 * n), ca.SX.sym("p", n, 9)
    theta, dtheta, q, dq = rotor[:n], rotor[n:], joint[:n], joint[n:]
    stiffness, damping, inertia, constant, limit, coulomb, static, load, viscous = ca.horzsplit(p)
    spring = stiffness * (theta - q) + damping * (dtheta - dq)
    motor = constant * ca.fmin(ca.fmax(current, -limit), limit)
    net = motor - spring
    friction = load * ca.fabs(spring)
    resting = coulomb + (static - coulomb) * ca.exp(-((dtheta / STRIBECK_VELOCITY) ** 2)) + friction
    breakaway = static + friction
    # at rest, what exceeds the static level starts the motion, against sliding friction from then on
    free = dtheta + dt * net / inertia
    level = ca.if_else(dtheta == 0, coulomb + friction, resting)
    slowed = _sign(free) * ca.fmax(ca.fabs(free) - dt * level / inertia, 0)
    moving = slowed / (1 + dt * viscous / inertia)
    held = ca.logic_and(dtheta == 0, ca.fabs(net) <= breakaway)
    dtheta_next = ca.if_else(held, 0, moving)
    theta_next = theta + dt * dtheta_next
    return ca.Function(
        "rotor_step", [rotor, current, joint, p], [ca.vertcat(theta_next, dtheta_next), spring],
        ["rotor", "current", "joint", "p"], ["next", "torque"],
    )  # fmt: skip


class SeriesElasticActuators:
    """The actuators of a robot. Reads and writes preallocated arrays; a step costs about a microsecond."""

    def __init__(
        self, robot: Robot, dt: float, friction_scale: float, compile: Callable[[ca.Function], ca.Function]
    ) -> None:
        n = len(robot.joints)
        self._n = n
        actuators = [joint.actuator for joint in robot.joints]
        self.rotor, self._next = np.zeros(2 * n), np.zeros(2 * n)  # angles, then velocities; seen from the joints
        self.current = np.zeros(n)  # A, demanded
        self._joint = np.zeros(2 * n)
        self.torque = np.zeros(n)  # N m on the joints during the last step
        self._stiffness = np.array([a.stiffness for a in actuators])
        self._damping = np.array([a.damping for a in actuators])
        parameters = np.array([
            [a.stiffness, a.damping, a.rotor_inertia, a.torque_per_ampere, a.current_limit,
             *(friction_scale * f for f in (a.coulomb, a.static, a.load_friction)), a.viscous]
            for a in actuators
        ])  # fmt: skip
        self._p = np.asfortranarray(parameters).ravel(order="F")
        self._buffer, self._evaluate = compile(rotor_step(n, dt)).buffer()
        for index, array in enumerate((self.rotor, self.current, self._joint, self._p)):
            self._buffer.set_arg(index, memoryview(array))  # type: ignore[call-arg, arg-type]
        for index, array in enumerate((self._next, self.torque)):
            self._buffer.set_res(index, memoryview(array))  # type: ignore[call-arg, arg-type]

    @property
    def theta(self) -> np.ndarray:
        """Rotor angles seen from the joints, rad."""
        return self.rotor[: self._n]

    @property
    def dtheta(self) -> np.ndarray:
        """Rotor velocities seen from the joints, rad/s."""
        return self.rotor[self._n :]

    def place(self, q: np.ndarray) -> None:
        """Put all rotors at rest with relaxed springs at joint angles ``q``."""
        self.rotor[: self._n] = q
        self.rotor[self._n :] = 0.0

    def spring_torque(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Torque of the springs now, N m."""
        return self._stiffness * (self.theta - q) + self._damping * (self.dtheta - dq)

    def step(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Advance the rotors by one step with ``current``; returns the torque on the joints, N m."""
        self._joint[: self._n] = q
        self._joint[self._n :] = dq
        self._evaluate()
        self.rotor[:] = self._next
        return self.torque

    def snapshot(self) -> Any:
        return self.rotor.copy(), self.current.copy(), self.torque.copy()

    def restore(self, state: Any) -> None:
        self.rotor[:], self.current[:], self.torque[:] = state
