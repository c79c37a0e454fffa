"""A robot that has settled, without what is not smooth: where its loop is linearised, with whatever values."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any, Self

from hil.errors import UserError
from hil.lab.linear.linearisation import Linearisation
from hil.lab.linear.standing import StandingSection, hyper_period
from hil.lab.quantity import Quantity, Value, changed, quantity
from hil.lab.transplant import movable, moved
from hil.run import Request, assemble
from hil.scenario import Scenario
from robots.description import Robot

# What a linear model has no place for, and its value in the system that is linearised.
SMOOTH: dict[str, Value] = {
    "world.friction_scale": 0.0,
    "sensors.noise": 0.0,
    "sensors.bias": 0.0,
    "sensors.gyro_drift": "0 deg/s",
    "controller.path.kind": "hold",
    "firmware.heartbeat_period": "0 s",  # the frames behind one are late
}
# By how much finer sensors and current loops are, as far as the 32 bits of the counts go, and the IMU's 16.
_FINER_ENCODER, _FINER = 4e3, 1e5  # encoders of angles; spring encoders, load cells, currents
_FINER_GYRO, _FINER_ACCELEROMETER = 10.0, 2.0

_STEP, _REST = 1e-3, 3e-3  # s: a delay grows in such steps, each after such a rest: its gaps must not wake the watchdog
_CALM = 0.02  # s from the last change to the section


def smooth(scenario: Scenario) -> Scenario:
    """``scenario`` of a robot that only stands, without dry friction, noise, bias, pushes, and faults to come."""
    return changed(scenario, SMOOTH).model_copy(update={"inject": (), "push": ()})


def fine(robot: Robot) -> Robot:
    """``robot`` with sensors and current loops of much finer resolution; the scales of the messages stay."""
    joints = tuple(
        joint.model_copy(update={
            "sensor": joint.sensor.model_copy(update={
                "encoder": joint.sensor.encoder * _FINER_ENCODER,
                "joint_encoder": joint.sensor.joint_encoder * _FINER_ENCODER,
                "torque_resolution": joint.sensor.torque_resolution / _FINER,
                "force_resolution": joint.sensor.force_resolution / _FINER,
            }),
            "actuator": joint.actuator.model_copy(update={
                "ampere_per_count": joint.actuator.ampere_per_count / _FINER,
            }),
        })
        for joint in robot.joints
    )  # fmt: skip
    imu = robot.imu
    if imu is not None:
        imu = imu.model_copy(update={
            "gyro_resolution": imu.gyro_resolution / _FINER_GYRO,
            "accelerometer_resolution": imu.accelerometer_resolution / _FINER_ACCELEROMETER,
        })  # fmt: skip
    return robot.model_copy(update={"joints": joints, "imu": imu})


class OperatingPoint:
    """``scenario``, made smooth, at ``at`` s. Use as a context manager, or ``close`` it.

    Raises UserError when the robot does not come that far, and for an orientation from motion capture: what that
    remembers is no part of the linear model.
    """

    def __init__(self, scenario: Scenario, at: float, settled: dict[str, Any] | None = None) -> None:
        from plant.stance import StanceError

        if scenario.world.shank_stiffness:
            raise UserError(f"{scenario.name}: shanks that bend are not linearised; set world.shank_stiffness=0")
        if scenario.controller.orientation != "complementary":
            raise UserError(
                f'controller.orientation = "{scenario.controller.orientation}": a linear model knows the complementary '
                "filter only"
            )
        self.scenario, self.at = smooth(scenario), at
        self._stack = contextlib.ExitStack()
        try:
            request = Request(self.scenario, backend="inline", signals=False)
            self.system = self._stack.enter_context(assemble(request, alter=fine)).system
        except StanceError as error:
            raise UserError(f"{scenario.name}: stance: {error}") from None
        self._ticks, self._common = hyper_period(self.system)
        if settled is None:
            self._run(at)
            if self.system.stop_reason is not None:
                raise UserError(
                    f"{scenario.name} without stiction does not stand until {at:g} s: {self.system.stop_reason}"
                )
            self.system.monitor = None  # it watches what goes on for long, not what is taken back
        else:
            self.system.monitor = None
            self.system.restore(moved(settled, self.system.snapshot()))
            self._run(self.now + _CALM)
        self._settled = self.system.snapshot()

    def elsewhere(self, quantity: Quantity, value: Value) -> OperatingPoint:
        """The robot as it stands here in a system where ``quantity`` has another value, if it can be put there;
        else one that has stood up with it."""
        scenario = quantity.applied(self.scenario, value)
        return OperatingPoint(scenario, self.at, self._settled if movable(quantity) else None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._stack.close()

    def _run(self, time: float) -> None:
        """To the first section at or after ``time``."""
        periods = math.ceil(round(time * self._common, 6))
        self.system.run_until(periods * self._ticks * 10**9 // int(self.scenario.firmware.rate))

    @property
    def now(self) -> float:
        return self.system.now_ns * 1e-9

    def section(self, values: Mapping[str, Value] | None = None) -> StandingSection:
        """The loop, displaceable, with injectable ``values`` (SI) that are reached without a jump."""
        system = self.system
        system.restore(self._settled)
        for key, value in (values or {}).items():
            self._reach(key, value)
        if values:
            self._run(self.now + _CALM + self.delay)
        for node in system.joints.nodes:
            if not node.powered:
                raise UserError(f"{node.name}'s drive is off {self.now:.3f} s after the start: {node.state.name}")
        return StandingSection(system, system.snapshot())

    def _reach(self, key: str, value: Value) -> None:
        known = quantity(self.scenario, key)
        if known.unit != "s" or not key.endswith(".delay"):
            self.system.inject(key, known.written(value))
            return
        present, wanted = float(self.system.injector.values[key]), float(value)
        steps = max(math.ceil(abs(wanted - present) / _STEP), 1)
        for step in range(1, steps + 1):
            self.system.inject(key, known.written(present + (wanted - present) * step / steps))
            self._run(self.now + _REST)

    def take_parameters(self) -> None:
        """Let the actuators' parameters, as they have been set by now, be those of this point."""
        world = self._settled["world"]
        parameters = self.system.world.actuators.snapshot()[-1]
        self._settled = {
            **self._settled, "world": {**world, "actuators": (*world["actuators"][:-1], parameters)},
        }  # fmt: skip

    @property
    def delay(self) -> float:
        """Longest way of data through the links and buses now, s."""
        return sum(float(value) for key, value in self.system.injector.values.items() if key.endswith(".delay"))

    def with_value(self, quantity: Quantity, value: Value) -> Linearisation:
        """The loop with ``quantity`` at ``value`` (SI)."""
        if quantity.injectable:
            return self.linearise({quantity.key: value})
        with self.elsewhere(quantity, value) as moved:
            return moved.linearise()

    def linearise(self, values: Mapping[str, Value] | None = None, scale: float | None = None) -> Linearisation:
        """The loop with injectable ``values`` (SI), by displacements of ``scale`` of their usual sizes; without, of the
        one that leaves least noise."""
        section = self.section(values)
        if scale is None:
            return Linearisation.cleanest(section, self.delay)
        return Linearisation.of(section, self.delay, scale)
