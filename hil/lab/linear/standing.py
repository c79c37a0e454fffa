"""The states of a robot that stands on both feet, in coordinates that keep apart what the feet hold and what is free.

The rows of S are the Jacobians of the free directions (centre of mass, torso's angles) and of the two contact points;
a displacement of the generalised coordinates by a column of S⁻¹ moves one of them alone. So the free directions take
displacements far above the rounding of the messages, while the feet, pressed on by their own elasticity of some µm,
take a few µm, and neither leaves the ground.

Beside these 2 nv states of the mechanics there are the rotors, what the drives' laws remember, and what the controller
remembers. What a law remembers of a position is told relative to that position: the encoder would seem to jump else.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import mujoco
import numpy as np

from central_controller.law import memory_names
from hil.backends.inline import InlineJoints
from hil.errors import UserError
from hil.lab.linear.delay_model import Array
from hil.lab.linear.section import trajectory
from hil.system import System
from joint_firmware.laws.monitor import Monitor

# Sizes of displacements (docs/linear-prediction.md shows what others would give).
_ANGLE, _LENGTH = 1e-3, 1e-3  # rad, m, of free directions
_ANGLE_RATE, _SPEED = 2e-2, 2e-2  # rad/s, m/s
_SINKING, _FOOT_SPEED = 0.4, 1e-3  # share of what the feet have sunk in by, m/s
_ROTOR, _ROTOR_RATE = 2e-3, 0.1  # rad, rad/s
_MEMORY = {"attitude": 1e-3, "velocity": 3e-2, "integral": 0.1, "internal": 2.0}  # of the controller: rad, rad/s, …
_PROBE = 8  # periods after which a drive's memory has seen what it will
_SILENT = 1e-9  # memory that moves by less has no part

_AXES = "xyz"
_TURNS = ("roll", "pitch", "yaw")


def hyper_period(system: System) -> tuple[int, int]:
    """Ticks of the joints, and the frequency in Hz, of the least common multiple of all periods."""
    scenario = system.scenario
    rates = [
        int(rate)
        for rate in (
            scenario.world.rate, scenario.firmware.rate, scenario.firmware.report_rate, scenario.controller.rate,
        )
    ]  # fmt: skip
    common = int(np.gcd.reduce(rates))
    return rates[1] // common, common


class StandingSection:
    """A system on the inline backend at a tick of its joints, as ``hil.lab.linear.section.Section``.

    ``origin`` is a snapshot between two events; the section is the first tick of the joints after it. Raises UserError
    when the robot does not stand on both feet.
    """

    def __init__(self, system: System, origin: dict[str, Any]) -> None:
        self._system, self._origin = system, origin
        self._ticks, common = hyper_period(system)
        self.period = 1.0 / common
        self._at = round(origin["now_ns"] * common / 1e9)  # hyper-periods so far
        self._k = 0
        world = system.world
        self._model = world.model
        self._n = len(world.robot.joints)
        self._nv, self._nq = self._model.nv, self._model.nq
        self._nodes = cast(InlineJoints, system.joints).nodes
        self._laws = [node.law for node in self._nodes]
        self._bank = world.actuators.symbols.state_index
        system.restore(origin)
        self._frame, names, sizes = self._coordinates()
        self._back = np.linalg.inv(self._frame)
        joints = world.robot.joint_names
        rates = [f"{name} speed" for name in names]
        self.names: tuple[str, ...] = (
            *names, *rates, *[f"{j} rotor" for j in joints], *[f"{j} rotor speed" for j in joints],
        )  # fmt: skip
        feet = tuple(foot.name for foot in world.robot.feet)
        speeds = [
            _FOOT_SPEED if name.startswith(feet) else _SPEED if name.startswith("CoM") else _ANGLE_RATE
            for name in names
        ]
        self.sizes = np.array([*sizes, *speeds, *[_ROTOR] * self._n, *[_ROTOR_RATE] * self._n])
        self._physical = len(self.names)
        self._law_states: list[tuple[int, int]] = []  # joint, index
        self._memory: list[int] = []
        self._remember()

    # --- coordinates ----------------------------------------------------------------------------------------

    def _coordinates(self) -> tuple[Array, list[str], list[float]]:
        """S (nv, nv), the names of its rows and the sizes of displacements along them."""
        model, world = self._model, self._system.world
        data, robot = world.data, world.robot
        torso = model.body(robot.base.name).id
        rows, names, sizes = [], [], []
        for foot in robot.feet:
            geom = model.geom(foot.name).id
            contacts = [c for c in data.contact[: data.ncon] if geom in (c.geom1, c.geom2) and c.dist < 0.0]
            if len(contacts) != 1:
                raise UserError(
                    f"{foot.name} does not stand at {self._origin['now_ns'] * 1e-9:.3f} s: the robot can be linearised "
                    "while it stands on both feet (--at chooses another time)"
                )
            jacobian = np.zeros((3, self._nv))
            mujoco.mj_jac(model, data, jacobian, None, contacts[0].pos, model.geom_bodyid[geom])
            rows += list(jacobian)
            names += [f"{foot.name} {axis}" for axis in _AXES]
            sizes += [-_SINKING * contacts[0].dist] * 3
        com, turn = np.zeros((3, self._nv)), np.zeros((3, self._nv))
        mujoco.mj_jacSubtreeCom(model, data, com, torso)
        mujoco.mj_jacBody(model, data, None, turn, torso)
        free = [(f"CoM {axis}", _LENGTH, row) for axis, row in zip(_AXES, com, strict=True)]
        free += [(name, _ANGLE, row) for name, row in zip(_TURNS, turn, strict=True)]
        chosen: list[tuple[str, float, Array]] = []
        for candidate in (free[0], free[2], free[4], free[3], free[5], free[1]):  # tasks first
            trial = np.array([*rows, *[row for _, _, row in chosen], candidate[2]])
            if len(rows) + len(chosen) < self._nv and np.linalg.cond(trial) < 1e4:
                chosen.append(candidate)
        if len(rows) + len(chosen) != self._nv:
            raise UserError("the legs are stretched out: the feet and the torso do not move by themselves there")
        return (
            np.array([*[row for _, _, row in chosen], *rows]),
            [*[name for name, _, _ in chosen], *names],
            [*[size for _, size, _ in chosen], *sizes],
        )

    def _remember(self) -> None:
        """Find which memories take part, and what they move by when the mechanics is displaced."""
        idle = set(Monitor().states)  # they only watch
        joints = self._system.world.robot.joint_names
        candidates = [
            (j, i) for j, law in enumerate(self._laws) for i, name in enumerate(law.states) if name not in idle
        ]
        names = memory_names(self._system.world.robot)
        self._law_states, self._memory = candidates, list(range(len(names)))
        swing = np.zeros(len(candidates) + len(names))
        for state, size in enumerate(self.sizes):
            step = np.zeros(self._physical + len(swing))
            step[state] = size
            ends = [trajectory(self, by, _PROBE) for by in (step, -step)]
            for ahead, behind in zip(*ends, strict=True):
                np.maximum(swing, np.abs(self.difference(ahead, behind)[self._physical :]) / 2.0, out=swing)
        of_law, of_memory = swing[: len(candidates)], swing[len(candidates) :]
        self._law_states = [c for c, size in zip(candidates, of_law, strict=True) if size > _SILENT]
        self._memory = [i for i, size in enumerate(of_memory) if size > _SILENT]
        self.names += tuple(f"{joints[j]} drive's {self._laws[j].states[i]}" for j, i in self._law_states)
        self.names += tuple(f"controller's {names[i]}" for i in self._memory)
        self.sizes = np.concatenate([
            self.sizes, of_law[of_law > _SILENT], [_MEMORY[names[i].split()[0]] for i in self._memory],
        ])  # fmt: skip

    # --- the section ----------------------------------------------------------------------------------------

    def displace(self, by: Array) -> None:
        origin = self._origin
        world, joints = origin["world"], origin["joints"]
        physics, bank = world["state"].copy(), world["actuators"][0].copy()
        laws = [joint["x"].copy() for joint in joints]
        memory = origin["controller"]["_memory"].copy()
        steps, speeds, thetas, rates, of_laws, of_memory = np.split(by, np.cumsum(
            [self._nv, self._nv, self._n, self._n, len(self._law_states)]
        ))  # fmt: skip
        self._move(physics, laws, self._back @ steps)
        physics[1 + self._nq : 1 + self._nq + self._nv] += self._back @ speeds
        for joint, index in enumerate(self._bank):
            bank[index["theta"]] += thetas[joint]
            bank[index["dtheta"]] += rates[joint]
            for i in self._positions(joint, ("motor", "deflection")):
                laws[joint][i] += thetas[joint]
        for (joint, i), amount in zip(self._law_states, of_laws, strict=True):
            laws[joint][i] += amount
        self._displace_memory(memory, of_memory)
        self._system.restore({
            **origin,
            "world": {**world, "state": physics, "actuators": (bank, *world["actuators"][1:])},
            "joints": [{**joint, "x": x} for joint, x in zip(joints, laws, strict=True)],
            "controller": {**origin["controller"], "_memory": memory},
        })  # fmt: skip
        self._k = 0

    def _move(self, physics: Array, laws: list[Array], step: Array) -> None:
        qpos = physics[1 : 1 + self._nq]
        mujoco.mj_integratePos(self._model, qpos, step, 1.0)
        for joint in range(self._n):
            for i in self._positions(joint, ("deflection",)):
                laws[joint][i] -= step[self._nv - self._n + joint]

    def _positions(self, joint: int, encoders: tuple[str, ...]) -> Iterator[int]:
        """Where the law of ``joint`` remembers positions of these encoders."""
        for i, name in enumerate(self._laws[joint].states):
            encoder, _, what = name.partition("_")
            if encoder in encoders and what in ("position", "start", "before"):
                yield i

    def _displace_memory(self, memory: Array, amounts: Array) -> None:
        whole = np.zeros(len(memory) - 1)  # three turns in place of four numbers
        whole[self._memory] = amounts
        quaternion = np.roll(memory[:4], 1)  # MuJoCo's order
        mujoco.mju_quatIntegrate(quaternion, whole[:3], 1.0)
        memory[:4] = np.roll(quaternion, -1)
        memory[4:] += whole[3:]

    def advance(self) -> None:
        self._k += 1
        periods = self._at + self._k
        self._system.run_until(periods * self._ticks * 10**9 // int(self._system.scenario.firmware.rate))

    def read(self) -> Any:
        system = self._system
        world = system.world
        return (
            world.data.qpos.copy(), world.data.qvel.copy(), world.actuators.state.copy(),
            [np.array(node.x) for node in self._nodes], system.controller.snapshot()["_memory"],
        )  # fmt: skip

    def difference(self, first: Any, second: Any) -> Array:
        step = np.zeros(self._nv)
        mujoco.mj_differentiatePos(self._model, step, 1.0, second[0], first[0])
        bank = first[2] - second[2]
        theta = np.array([bank[index["theta"]] for index in self._bank])
        dtheta = np.array([bank[index["dtheta"]] for index in self._bank])
        deflection = theta - step[-self._n :]
        laws = [a - b for a, b in zip(first[3], second[3], strict=True)]
        for joint, change in enumerate(laws):
            for i in self._positions(joint, ("motor",)):
                change[i] -= theta[joint]
            for i in self._positions(joint, ("deflection",)):
                change[i] -= deflection[joint]
        memory = self._memory_difference(first[4], second[4])
        return np.concatenate([
            self._frame @ step, self._frame @ (first[1] - second[1]), theta, dtheta,
            [laws[j][i] for j, i in self._law_states], memory[self._memory],
        ])  # fmt: skip

    @staticmethod
    def _memory_difference(first: Array, second: Array) -> Array:
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, np.roll(first[:4], 1), np.roll(second[:4], 1))
        return np.concatenate([turn, first[4:] - second[4:]])
