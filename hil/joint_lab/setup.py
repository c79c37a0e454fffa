"""What is examined: one joint with its load, firmware and timing. Theory and emulation are made from the same one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import casadi as ca

from bus.messages import GainSet, Mode, Setpoint, State
from hil.joint_lab import hydraulics
from hil.joint_lab.actuator import LinearActuator, StateSpace, state_space
from hil.joint_lab.law import sampled_law
from hil.joint_lab.master import Command
from hil.joint_lab.sampled import SampledLaw, SampledPlant, discretise
from joint_firmware.config import FirmwareConfig
from plant.bench import Inertia, Load, Locked
from plant.config import SensorConfig
from robots.actuators import Hydraulic
from robots.description import Joint, Robot


def linear_actuator(joint: Joint, load: Load) -> LinearActuator:
    """The linear model of ``joint`` with ``load``, without dry friction, in equivalent rotary coordinates.

    Raises ValueError for a load that is not linear, and for an actuator without the numbers of the model.
    """
    a = joint.actuator
    for name in ("rotor_inertia", "viscous", "stiffness", "damping", "torque_per_ampere"):
        if not hasattr(a, name):  # one of a user's own
            raise ValueError(f"{joint.name}: {type(a).__name__} has no {name}, which the linear model needs")
    clamped = LinearActuator(a.rotor_inertia, a.viscous, a.stiffness, a.damping, a.torque_per_ampere)
    if isinstance(load, Locked):
        return clamped
    if isinstance(load, Inertia):
        seen = 1.0 / ratio(joint, load.at) ** 2  # through the linkage
        return clamped._replace(load=seen * load.inertia, load_damping=seen * load.damping)
    raise ValueError("load: a pendulum is not linear, locked and inertia are")


def ratio(joint: Joint, q: float) -> float:
    """f'(q): torque on the joint per effort (``robots.actuators``)."""
    linkage = joint.actuator.linkage
    return 1.0 if linkage is None else float(linkage.ratio(q))


class Timing(NamedTuple):
    """When things happen. Rates in Hz, times in s."""

    servo_rate: float  # of the master
    physics_rate: float  # a multiple of the interrupt rate
    servo_phase: float = 0.25e-3  # from the drive's report to the master's tick: its state has arrived
    command_delay: float = 0.0  # from the master's tick to its command on the bus
    loop_delay: float = 0.0  # between drive and actuator, in steps of the physics


class Setup(NamedTuple):
    """Everything that determines an experiment on a joint."""

    robot: Robot
    joint_index: int
    firmware: FirmwareConfig
    load: Load
    sensors: SensorConfig
    timing: Timing
    friction_scale: float = 1.0
    gain_set: int = GainSet.STANCE
    mode: int = Mode.TORQUE  # or OPEN_LOOP: without a torque loop
    seed: int = 0
    compile: Callable[[ca.Function], ca.Function] = lambda function: function

    @property
    def joint(self) -> Joint:
        return self.robot.joints[self.joint_index]

    @property
    def bus(self) -> str:
        """Name of the joint's bus."""
        return next(bus.name for bus in self.robot.buses if self.joint.name in bus.joints)

    @property
    def slot(self) -> int:
        """The joint's slot in the commands on its bus."""
        return next(bus.joints.index(self.joint.name) for bus in self.robot.buses if self.joint.name in bus.joints)

    @property
    def period(self) -> float:
        """Of the drive's interrupts, s."""
        return 1.0 / self.firmware.rate

    @property
    def ticks_per_report(self) -> int:
        return round(self.firmware.rate / self.firmware.report_rate)

    def actuator(self) -> LinearActuator:
        """Raises ValueError for a load that is not linear."""
        return linear_actuator(self.joint, self.load)

    def torque_command(self, of: Callable[[int, State], float]) -> Command:
        """A master's command: ``of(servo tick, state)`` in N m."""
        return lambda tick, state: Setpoint(mode=self.mode, gain_set=self.gain_set, torque=of(tick, state))

    def plant(self) -> SampledPlant:
        """What the drive's law acts on: an output takes effect one interrupt after it was computed, plus the extra
        delay. Raises ValueError for a load that is not linear."""
        return discretise(self.model(), self.period, self.period + self.timing.loop_delay)

    def model(self) -> StateSpace:
        """From motor torque to (motor coordinate, deflection); of a hydraulic joint from the valve's effort to (joint
        angle, effort). Raises ValueError for a load that is not linear."""
        if self.hydraulic:
            return hydraulics.state_space(self.joint, self.load)
        return state_space(self.actuator())

    @property
    def hydraulic(self) -> bool:
        return isinstance(self.joint.actuator, Hydraulic)

    def law(self) -> SampledLaw:
        """The drive's law. Raises ValueError where it cannot be linearised."""
        return sampled_law(self.joint, self.firmware, self.gain_set, self.mode, self.load.at)

    @property
    def torque_per_sensed(self) -> float:
        """Torque that the drive reports per deflection, N m/rad; of a hydraulic joint per effort."""
        stiffness = 1.0 if self.hydraulic else self.joint.actuator.stiffness
        return ratio(self.joint, self.load.at) * stiffness

    def delayed(self, loop_delay: float) -> Setup:
        """The same with ``loop_delay`` s between drive and actuator."""
        return self._replace(timing=self.timing._replace(loop_delay=loop_delay))

    @property
    def nyquist(self) -> float:
        """Half the interrupt rate, rad/s."""
        return math.pi * self.firmware.rate
