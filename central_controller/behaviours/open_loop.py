"""Steps by joint positions planned beforehand (Kim 2018 §7.1): the drives' joint-position loops do the rest."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bus import messages
from bus.messages import GainSet, Mode
from central_controller.behaviours.behaviour import Compile, Phase, Setpoints, Workspace
from central_controller.behaviours.stand import ramp
from central_controller.law import ORIENTATION, estimate, memory_size
from central_controller.planning.open_loop import plan
from robots.description import Robot

_PLAIN = ("com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference")
_EVERY_JOINT = ("torque_command", "torque_sensed", "q", "dq", "q_reference")


class OpenLoop:
    """Goes through the plan; what is measured only decides when a landing counts: the plan waits for the foot.

    ``com`` in the telemetry is where the joints and the orientation put the centre of mass above the planned place of
    the stance foot; nothing is fed back from it.
    """

    def __init__(self, workspace: Workspace, compile: Compile) -> None:
        config = workspace.config
        self._space, self._config = workspace, config
        self._plan = motion = plan(workspace.robot, config.open_loop, config.rate, config.blocks or ())
        self._joints = n = len(workspace.robot.joints)
        self._swings = [
            (math.floor(swing.lift_off * config.rate), math.ceil(swing.landing * config.rate), swing.foot)
            for swing in motion.swings
        ]
        robot = workspace.robot
        legs = [None, *(_leg(robot, foot.joint) for foot in robot.feet)]  # which swings: none, the right, the left
        self._modes = [[_mode(joint.name, leg) for joint in robot.joints] for leg in legs]
        self._gain_sets = [[_gain_set(joint.name, leg) for joint in robot.joints] for leg in legs]
        self.telemetry = np.zeros(len(self.fields(workspace.robot)))
        at = len(self.fields(workspace.robot)) - len(_EVERY_JOINT) * n
        self.torque = self.telemetry[at : at + n]
        self._sensed, self._q, self._dq, self._wanted = (
            self.telemetry[at + i * n : at + (i + 1) * n] for i in range(1, 5)
        )
        self.memory, self.memory_next = np.zeros(memory_size(n)), np.zeros(memory_size(n))
        self.setpoints = Setpoints(n, Mode.JOINT_POSITION, GainSet.STANCE)
        self._hold = np.zeros(n)  # where the joints were when it took over, rad
        self._rest = [0.0] * n
        self._progress = 0  # ticks of the plan
        self._waited = 0

    @staticmethod
    def fields(robot: Robot) -> list[str]:
        """Names of ``telemetry``, in order."""
        names = [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
        names += [*_PLAIN, "internal_force", "internal_force_reference"]
        return names + [f"{what}.{joint}" for what in _EVERY_JOINT for joint in robot.joint_names]

    def act(self, phase: Phase, now_ns: int, since_ns: int) -> None:
        space, n = self._space, self._joints
        self.memory_next[estimate(n)] = self.memory[estimate(n)]
        self.memory_next[ORIENTATION] = space.q[3:7]
        self.memory_next[4 : 4 + n] = space.v[6:]
        np.multiply(space.counts[2 * n :], messages.NEWTON_METRE, out=self._sensed)
        self._q[:], self._dq[:] = space.q[7:], space.v[6:]
        share = 1.0
        if phase is Phase.RAMP:
            share = ramp(self._config.weight_ramp, self._config.rate, now_ns - since_ns)
        elif phase is Phase.ON and now_ns * 1e-9 >= self._config.open_loop.start:
            self._go_on()
        self._set(share)
        self._tell()

    def _go_on(self) -> None:
        """One tick further, unless a foot that should have landed has not."""
        config, contacts = self._config, self._space.contacts
        for _, landing, foot in self._swings:
            if self._progress == landing and not contacts[foot] and self._waited < config.open_loop.wait * config.rate:
                self._waited += 1
                return
        self._waited = 0
        self._progress = min(self._progress + 1, len(self._plan.times) - 1)

    def _set(self, share: float) -> None:
        motion, at = self._plan, self._progress
        self._wanted[:] = motion.positions[at]
        if share < 1.0:
            self._wanted *= share
            self._wanted += (1.0 - share) * self._hold
        np.multiply(motion.torques[at], self._config.open_loop.feed_forward * share, out=self.torque)
        setpoints = self.setpoints
        setpoints.positions = self._wanted.tolist()
        setpoints.velocities = self._rest if self._waited else motion.velocities[at].tolist()
        swinging = 0
        for lift_off, landing, foot in self._swings:
            if lift_off < at <= landing:
                swinging = 1 + foot
        setpoints.modes, setpoints.gain_sets = self._modes[swinging], self._gain_sets[swinging]

    def _tell(self) -> None:
        """Where the centre of mass is planned to be, and where the joints put it."""
        motion, at, told = self._plan, self._progress, self.telemetry
        x, y, z, w = self._space.q[3:7].tolist()
        told[8] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        told[9] = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        told[10] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        told[6:8] = motion.com[at]

    def take_over(self) -> None:
        self._hold[:] = self._space.q[7:]

    _ARRAYS = ("telemetry", "memory_next", "_hold")

    def snapshot(self) -> Any:
        return [getattr(self, name).copy() for name in self._ARRAYS], self._progress, self._waited

    def restore(self, state: Any) -> None:
        arrays, self._progress, self._waited = state
        for name, value in zip(self._ARRAYS, arrays, strict=True):
            getattr(self, name)[:] = value


def _mode(joint: str, swinging: set[str] | None) -> int:
    """A leg that carries nothing is fed back from its motors: from joints behind soft springs it oscillates."""
    return Mode.POSITION if swinging and joint in swinging else Mode.JOINT_POSITION


def _gain_set(joint: str, swinging: set[str] | None) -> int:
    return GainSet.SWING if swinging and joint in swinging else GainSet.STANCE


def _leg(robot: Robot, tip: str) -> set[str]:
    """Names of the joints from the base to ``tip``."""
    parents = {joint.name: joint.parent for joint in robot.joints}
    names = set()
    while tip != robot.base.name:
        names.add(tip)
        tip = parents[tip]
    return names
