"""What an actuator is to the plant: equations of one joint in CasADi symbols.

To add one, describe it (a class derived from ``robots.actuators.Actuator``) and derive its model:

    class MyModel(ActuatorModel, describes=MyActuator): ...

The bank (``plant.actuators.bank``) compiles all actuators of a robot into one function per physics step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

from robots.actuators import Actuator

Symbol = Any  # a scalar casadi.SX


class Inputs(NamedTuple):
    """What acts on an actuator during a step."""

    current: Symbol  # A, demanded of the drive; 0 with the power stage off
    supply: Symbol  # V, of the supply without load
    q: Symbol  # rad, joint angle
    dq: Symbol  # rad/s


class Sensed(NamedTuple):
    """What there is to measure; motor, deflection, effort in equivalent rotary coordinates (``robots.actuators``)."""

    motor: Symbol  # rad
    motor_velocity: Symbol  # rad/s
    deflection: Symbol  # rad, of the compliant element
    effort: Symbol  # N m, what a load cell at the output measures, times the nominal arm
    torque: Symbol  # N m on the joint
    current: Symbol  # A, that flows
    temperature: Symbol  # °C, of the winding
    supply: Symbol  # V, under load


class NoModelError(LookupError):
    """An actuator is described that nobody has given a model."""


class ActuatorModel(ABC):
    """Equations of one actuator. ``x`` and ``p`` have one attribute per name of ``rest`` and ``parameters``."""

    friction: ClassVar[tuple[str, ...]] = ()  # parameters that world.friction_scale scales
    _of: ClassVar[dict[type[Actuator], type[ActuatorModel]]] = {}

    def __init_subclass__(cls, describes: type[Actuator] | None = None, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if describes is not None:
            ActuatorModel._of[describes] = cls

    def __init__(self, actuator: Any) -> None:
        self.actuator = actuator

    @staticmethod
    def of(actuator: Actuator) -> ActuatorModel:
        """The model of what ``actuator`` describes. Raises NoModelError when there is none."""
        for described in type(actuator).__mro__:
            if described in ActuatorModel._of:
                return ActuatorModel._of[described](actuator)
        name = type(actuator).__name__
        raise NoModelError(f"there is no model of {name}: derive one, class MyModel(ActuatorModel, describes={name})")

    @abstractmethod
    def parameters(self) -> Mapping[str, float]:
        """Numbers that may change while the plant runs, by name."""

    @abstractmethod
    def rest(self, q: float) -> Mapping[str, float]:
        """The state by name, at rest and without effort with the joint at ``q`` [rad]."""

    @abstractmethod
    def step(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace, dt: float) -> tuple[Mapping[str, Symbol], Symbol]:
        """The state after ``dt`` [s], and the torque on the joint [N m] meanwhile.

        Semi-implicit Euler: forces from the state at the start act on both sides, as MuJoCo integrates the joint.
        """

    @abstractmethod
    def sense(self, x: SimpleNamespace, u: Inputs, p: SimpleNamespace) -> Sensed:
        """What there is to measure in state ``x``."""
