"""One actuator on a bench: its motor and spring drive a simple load, or an output that is clamped."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from plant.actuators.bank import ActuatorBank
from plant.config import SensorConfig
from plant.joint_faults import FaultyJoints
from plant.sensors import JointSensors
from robots import pins
from robots.description import Joint, Robot
from robots.quantities import Config, Kilograms, KilogramSquareMetres, Metres, Radians, TorquePerRate

# of a load on the actuator's spring, in a step; semi-implicit Euler is stable while the first plus twice the second is
# below 4
_STIFFEST = 0.25  # rad², of its oscillation
_MOST_DAMPED = 0.5  # share of its velocity that the damper takes


class Locked(Config):
    """The output is clamped."""

    at: Radians = 0.0


class Inertia(Config):
    """A flywheel."""

    inertia: KilogramSquareMetres = 0.5
    damping: TorquePerRate = 0.5  # viscous
    at: Radians = 0.0  # where it starts, at rest


class Pendulum(Config):
    """A point mass on a massless rod; it hangs down at 0."""

    mass: Kilograms = 3.0
    length: Metres = 0.4
    damping: TorquePerRate = 0.5
    at: Radians = 0.0

    @property
    def inertia(self) -> float:
        return self.mass * self.length**2


Load = Locked | Inertia | Pendulum
LOADS: dict[str, type[Locked] | type[Inertia] | type[Pendulum]] = {
    "locked": Locked, "inertia": Inertia, "pendulum": Pendulum,
}  # fmt: skip


def _identity(function: ca.Function) -> ca.Function:
    return function


def _lightest(joint: Joint, dt: float) -> float:
    """Inertia, kg m², that a step of ``dt`` can still follow on the actuator's spring."""
    a, ratio = joint.actuator, 1.0
    if a.linkage is not None:
        ratio = max(abs(float(a.linkage.ratio(q))) for q in np.linspace(*joint.limits, 50))
    return ratio**2 * max(a.stiffness * dt**2 / _STIFFEST, a.damping * dt / _MOST_DAMPED)


class Bench:
    """A joint's actuator (``plant.actuators``) and sensors (``plant.sensors``) with ``load`` on its output,

        I ddq = tau_s − b dq − m g l sin q

    in semi-implicit Euler steps at ``rate`` Hz, like the actuator; viscous damping is implicit.

    ``pins_in`` and ``pins_out`` are the drive's pins. Raises ValueError for a load so light that a step could not
    follow its oscillation on the spring.
    """

    def __init__(
        self,
        robot: Robot,
        joint_index: int,
        load: Load,
        rate: float,
        sensors: SensorConfig,
        streams: Callable[[str], Any],
        friction_scale: float = 1.0,
        compile: Callable[[ca.Function], ca.Function] = _identity,
    ) -> None:
        joint = robot.joints[joint_index]
        alone = robot.model_copy(update={"joints": (joint,), "feet": ()})
        alone.__dict__.pop("joint_names", None)  # cached from the whole robot
        self._dt = 1.0 / rate
        self._locked = isinstance(load, Locked)
        if not isinstance(load, Locked):
            lightest = _lightest(joint, self._dt)
            if load.inertia < lightest:
                raise ValueError(
                    f"inertia of {load.inertia:.3g} kg m²: expected at least {lightest:.2g} kg m², for the spring of "
                    f"{joint.actuator.stiffness:g} N m/rad at {rate:g} steps per second"
                )
            self._inertia, self._damping = load.inertia, load.damping
        self._weight = load.mass * robot.gravity * load.length if isinstance(load, Pendulum) else 0.0  # N m
        self._q, self._dq = np.array([load.at]), np.zeros(1)
        self.actuator = ActuatorBank(alone, self._dt, friction_scale, compile, self._q, self._dq)
        self._sensors = JointSensors(alone, sensors, streams, compile, self.actuator)
        self.faults = FaultyJoints(alone, self.actuator, streams)
        self._ampere_per_count = joint.actuator.ampere_per_count
        self._inputs = np.zeros((1, pins.N_INPUTS), np.int32)
        self._outputs = np.zeros((1, pins.N_OUTPUTS), np.int32)
        self.pins_in, self.pins_out = self._inputs[0], self._outputs[0]

    @property
    def position(self) -> float:
        """Angle of the output, rad."""
        return float(self._q[0])

    @property
    def velocity(self) -> float:
        """rad/s."""
        return float(self._dq[0])

    @property
    def spring_torque(self) -> float:
        """Torque of the actuator on the load now, N m."""
        return float(self.actuator.observe().torque[0])

    def sample(self) -> None:
        """Write the drive's input pins from the present state."""
        self._sensors.write(self._inputs, ())
        if self.faults.on_pins:
            self.faults.apply(self._inputs)

    def latch(self) -> None:
        """Let the drive's output pins take effect from now on."""
        demand, enable = int(self.pins_out[pins.CURRENT_DEMAND]), int(self.pins_out[pins.ENABLE])
        self.actuator.current[0] = demand * self._ampere_per_count if enable else 0.0

    def step(self) -> None:
        """Advance by one step."""
        torque = self.actuator.step()[0] + self.faults.load[0]
        if self._locked:
            return
        dt, q = self._dt, self._q[0]
        free = self._dq[0] + dt * (torque - self._weight * math.sin(q)) / self._inertia
        self._dq[0] = free / (1.0 + dt * self._damping / self._inertia)
        self._q[0] = q + dt * self._dq[0]

    def snapshot(self) -> dict[str, Any]:
        return {
            "load": (self._q.copy(), self._dq.copy()),
            "actuator": self.actuator.snapshot(),
            "sensors": self._sensors.snapshot(),
            "faults": self.faults.snapshot(),
            "pins": (self._inputs.copy(), self._outputs.copy()),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._q[:], self._dq[:] = state["load"]
        self.actuator.restore(state["actuator"])
        self._sensors.restore(state["sensors"])
        self.faults.restore(state["faults"])
        self._inputs[:], self._outputs[:] = state["pins"]
