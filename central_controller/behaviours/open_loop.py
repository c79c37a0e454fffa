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
from central_controller.planning.open_loop import RIGHT_FOOT, plan
from robots.description import Robot

_PLAIN = ("com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference")
_EVERY_JOINT = ("torque_command", "torque_sensed", "q", "dq", "q_reference")


class OpenLoop:
    """Goes through the plan. What is measured only decides when a landing counts, for which the plan waits, and how the
    drives of a leg hold its joints: from the joints themselves while its foot carries, else from the motors.

    ``com`` in the telemetry is where the joints and the orientation put the centre of mass, if the stance foot is where
    it is planned to be; nothing is fed back from it.
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
        legs = [_leg(robot, foot.joint) for foot in robot.feet]
        free = [set().union(*(leg for n, leg in enumerate(legs) if bits >> n & 1)) for bits in range(1 << len(legs))]
        self._modes = [[_mode(joint.name, names) for joint in robot.joints] for names in free]
        self._gain_sets = [[_gain_set(joint.name, names) for joint in robot.joints] for names in free]
        self._touched = [0] * len(legs)  # ticks for which each foot has touched the ground
        self._settled = round(config.open_loop.settled * config.rate)
        self.telemetry = np.zeros(len(self.fields(workspace.robot)))
        at = len(self.fields(workspace.robot)) - len(_EVERY_JOINT) * n
        self.telemetry[at - 2] = math.nan  # the internal force is not sensed; none is wanted
        self.torque = self.telemetry[at : at + n]
        self._sensed, self._q, self._dq, self._wanted = (
            self.telemetry[at + i * n : at + (i + 1) * n] for i in range(1, 5)
        )
        self.memory, self.memory_next = np.zeros(memory_size(n)), np.zeros(memory_size(n))
        self.setpoints = Setpoints(n, Mode.JOINT_POSITION, GainSet.STANCE)
        sources = workspace.model.sources
        self._com, self._com_velocity = sources["com_0"], sources["vcom_0"]
        self._kinematics = [
            [sources[f"{foot.name}_{what}"] for what in ("translation", "rotation", "v")] for foot in robot.feet
        ]
        self._levers = [np.array(foot.position) for foot in robot.feet]
        self._arm = np.zeros(3)
        self._stance = self._stance_feet(len(motion.times))
        self._hold = np.zeros(n)  # where the joints were when it took over, rad
        self._rest = [0.0] * n
        self._progress = 0  # ticks of the plan
        self._waited = 0

    def _stance_feet(self, ticks: int) -> list[int]:
        """By tick: the foot that stands alone, or, on both, the one that has done so last; the front one at first."""
        stance, at = [RIGHT_FOOT] * ticks, 0
        for lift_off, _, foot in self._swings:
            at = lift_off + 1
            stance[at:] = [1 - foot] * (ticks - at)
        return stance

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
        free = self._free(at)
        setpoints.modes, setpoints.gain_sets = self._modes[free], self._gain_sets[free]

    def _free(self, at: int) -> int:
        """The legs that carry nothing at tick ``at`` of the plan, a bit each: by plan, or as their switches tell."""
        free = 0
        for foot, touches in enumerate(self._space.contacts.tolist()):
            self._touched[foot] = self._touched[foot] + 1 if touches else 0
            if self._touched[foot] <= self._settled:
                free |= 1 << foot
        for lift_off, landing, foot in self._swings:
            if lift_off < at <= landing:
                free |= 1 << foot
        return free

    def _tell(self) -> None:
        """Where the centre of mass is planned to be, and where the joints put it."""
        motion, at, told = self._plan, self._progress, self.telemetry
        x, y, z, w = self._space.q[3:7].tolist()
        told[8] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        told[9] = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        told[10] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        told[6:8] = motion.com[at]
        foot = self._stance[at]
        translation, rotation, velocity = self._kinematics[foot]
        com, speed, lever = told[0:3], told[3:6], self._levers[foot]
        np.matmul(rotation, lever, out=self._arm)
        np.subtract(self._com, translation, out=com)
        com -= self._arm  # from the foot
        com[0] += motion.feet[at, foot, 0]
        com[2] += motion.feet[at, foot, 1]
        (lx, ly, lz), (vx, vy, vz, wx, wy, wz) = lever.tolist(), velocity.tolist()
        self._arm[:] = vx + wy * lz - wz * ly, vy + wz * lx - wx * lz, vz + wx * ly - wy * lx
        np.matmul(rotation, self._arm, out=speed)
        np.subtract(self._com_velocity, speed, out=speed)

    def take_over(self) -> None:
        self._hold[:] = self._space.q[7:]

    _ARRAYS = ("telemetry", "memory_next", "_hold")

    def snapshot(self) -> Any:
        return [getattr(self, name).copy() for name in self._ARRAYS], self._progress, self._waited, self._touched.copy()

    def restore(self, state: Any) -> None:
        arrays, self._progress, self._waited, touched = state
        self._touched = touched.copy()
        for name, value in zip(self._ARRAYS, arrays, strict=True):
            getattr(self, name)[:] = value


def _mode(joint: str, free: set[str]) -> int:
    """A leg that carries nothing is fed back from its motors: from joints behind soft springs it oscillates."""
    return Mode.POSITION if joint in free else Mode.JOINT_POSITION


def _gain_set(joint: str, free: set[str]) -> int:
    return GainSet.SWING if joint in free else GainSet.STANCE


def _leg(robot: Robot, tip: str) -> set[str]:
    """Names of the joints from the base to ``tip``."""
    parents = {joint.name: joint.parent for joint in robot.joints}
    names = set()
    while tip != robot.base.name:
        names.add(tip)
        tip = parents[tip]
    return names
