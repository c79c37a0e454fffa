"""All actuators of a robot as one compiled function per physics step, bound to arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

import plant.actuators  # noqa: F401  the models that come with the project
from plant.actuators.model import ActuatorModel, Inputs, Sensed
from robots.description import Robot


class Symbols:
    """The equations of ``models`` as one: argument vectors, and what follows from them.

    Arguments, in this order: state, current [A], supply [V], q [rad], dq [rad/s], parameters; state and parameters
    joint by joint, the others one number per joint.
    """

    def __init__(self, models: Sequence[ActuatorModel], dt: float) -> None:
        n = len(models)
        rests = [list(model.rest(0.0)) for model in models]
        names = [list(model.parameters()) for model in models]
        self.state = ca.SX.sym("state", sum(map(len, rests)))
        self.current, self.supply = ca.SX.sym("current", n), ca.SX.sym("supply", n)
        self.q, self.dq = ca.SX.sym("q", n), ca.SX.sym("dq", n)
        self.p = ca.SX.sym("p", sum(map(len, names)))
        self.state_index = _index(rests)
        self.p_index = _index(names)
        following, torques = [], []
        self.sensed: list[Sensed] = []
        for k, model in enumerate(models):
            x = SimpleNamespace(**{name: self.state[at] for name, at in self.state_index[k].items()})
            p = SimpleNamespace(**{name: self.p[at] for name, at in self.p_index[k].items()})
            u = Inputs(self.current[k], self.supply[k], self.q[k], self.dq[k])
            after, torque = model.step(x, u, p, dt)
            if set(after) != set(rests[k]):
                raise ValueError(f"{type(model).__name__}: step gives {sorted(after)}, rest gives {sorted(rests[k])}")
            following += [after[name] for name in rests[k]]
            torques.append(torque)
            self.sensed.append(model.sense(x, u, p))
        self.next, self.torque = ca.vertcat(*following), ca.vertcat(*torques)

    @property
    def arguments(self) -> list[ca.SX]:
        return [self.state, self.current, self.supply, self.q, self.dq, self.p]

    def step(self) -> ca.Function:
        """``(*arguments) -> (next, torque)``."""
        return ca.Function(
            "actuators_step", self.arguments, [self.next, self.torque],
            ["state", "current", "supply", "q", "dq", "p"], ["next", "torque"],
        )  # fmt: skip

    def observe(self) -> ca.Function:
        """``(*arguments) -> sensed[n, fields of Sensed]``."""
        rows = [ca.vertcat(*column) for column in zip(*self.sensed, strict=True)]
        return ca.Function("actuators_observe", self.arguments, [ca.horzcat(*rows)])


def _index(names: Sequence[Sequence[str]]) -> list[dict[str, int]]:
    """Where each name of each joint lies in one vector."""
    index, at = [], 0
    for own in names:
        index.append({name: at + k for k, name in enumerate(own)})
        at += len(own)
    return index


class ActuatorBank:
    """The actuators of a robot. Reads and writes preallocated arrays; ``q`` and ``dq`` are read where they lie.

    ``current`` [A] is demanded, ``supply`` [V] is there without load, ``torque`` [N m] acted during the last step.
    """

    def __init__(
        self,
        robot: Robot,
        dt: float,
        friction_scale: float,
        compile: Callable[[ca.Function], ca.Function],
        q: np.ndarray,
        dq: np.ndarray,
    ) -> None:
        self.names = robot.joint_names
        self._models = [ActuatorModel.of(joint.actuator) for joint in robot.joints]
        n = len(self._models)
        self.symbols = Symbols(self._models, dt)
        self._q = q
        self.state, self._next = (np.zeros(self.symbols.state.numel()) for _ in range(2))
        self.current, self.torque = np.zeros(n), np.zeros(n)
        self.supply = np.array([joint.actuator.supply_voltage for joint in robot.joints])
        self.p = np.array([
            value * (friction_scale if name in model.friction else 1.0)
            for model in self._models
            for name, value in model.parameters().items()
        ])  # fmt: skip
        self.arguments = (self.state, self.current, self.supply, q, dq, self.p)
        self._observed = np.zeros((len(Sensed._fields), n))
        self._seen = Sensed(*self._observed)
        self._bound: list[Any] = []  # CasADi keeps addresses only
        self._evaluate = self.bind(compile(self.symbols.step()), self._next, self.torque)
        self._observe = self.bind(compile(self.symbols.observe()), self._observed.reshape(-1))
        self.place()

    def bind(self, function: ca.Function, *results: np.ndarray, more: Sequence[np.ndarray] = ()) -> Callable[[], None]:
        """A call of ``function`` on the bank's arguments and ``more``, into ``results``, without any allocation."""
        buffer, evaluate = function.buffer()
        arguments = (*self.arguments, *more)
        for index, array in enumerate(arguments):
            buffer.set_arg(index, memoryview(array))  # type: ignore[call-arg, arg-type]
        for index, array in enumerate(results):
            buffer.set_res(index, memoryview(array))  # type: ignore[call-arg, arg-type]
        self._bound.append((buffer, arguments, results))
        return evaluate

    def place(self) -> None:
        """Put all actuators at rest, without effort, where the joints are."""
        for model, index, q in zip(self._models, self.symbols.state_index, self._q, strict=True):
            for name, value in model.rest(float(q)).items():
                self.state[index[name]] = value

    def step(self) -> np.ndarray:
        """Advance by one step; returns the torque on the joints, N m."""
        self._evaluate()
        self.state[:] = self._next
        return self.torque

    def observe(self) -> Sensed:
        """What there is to measure now, one array (n,) per field; they are reused."""
        self._observe()
        return self._seen

    def parameters(self, joint: int) -> tuple[str, ...]:
        """Names of what ``get`` and ``set`` know of ``joint``."""
        return tuple(self.symbols.p_index[joint])

    def get(self, joint: int, name: str) -> float:
        """A parameter's value. Raises KeyError for a name that the joint's actuator does not have."""
        return float(self.p[self.symbols.p_index[joint][name]])

    def set(self, joint: int, name: str, value: float) -> None:
        """Change a parameter from the next step on. Raises KeyError as ``get``."""
        self.p[self.symbols.p_index[joint][name]] = value

    def snapshot(self) -> Any:
        return tuple(a.copy() for a in (self.state, self.current, self.supply, self.torque, self.p))

    def restore(self, state: Any) -> None:
        self.state[:], self.current[:], self.supply[:], self.torque[:], self.p[:] = state
