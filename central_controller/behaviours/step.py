"""Stepping: a state machine of support phases around the laws of double and single support (Kim 2018 Figs. 2.1, 7.15).

Horizontally the robot falls where it will; where it steps decides how it goes on. The planner places each foot from the
state that the pendulum observer tells.
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum
from functools import partial
from typing import Any

import numpy as np

from bus import messages
from bus.messages import GainSet, Mode
from central_controller.behaviours.behaviour import Compile, Phase, Setpoints, Workspace, ramp
from central_controller.behaviours.footholds import Footholds
from central_controller.binding import Bound, items
from central_controller.planning.pendulum import Foot
from central_controller.planning.swing import SwingTrajectory
from central_controller.planning.velocity_reversal import Plan
from central_controller.stepping_law import COORDINATES, OBSERVED, observed, stepping
from robots.description import Robot

_SAGITTAL = 0.999  # of a joint's axis along y: from here on it turns in the sagittal plane
_LANDED_AFTER = 0.5  # of the landing: a switch that is closed before has not opened yet
_COM, _COM_VELOCITY, _RPY, _FEET = map(observed, ("com", "com_velocity", "rpy", "feet"))
_REACTION, _FELT = observed("reaction"), observed("felt")
_COM_Y, _COM_Z, _YAW, _FOOT = map(COORDINATES.index, ("com_y", "com_z", "yaw", "foot_x"))


class State(IntEnum):
    """States of stepping."""

    WAITING = 0  # both feet stand; the first step has not begun
    LEANING = 1  # the centre of mass is set in motion towards the first stance foot
    UNLOADING = 2  # of the foot that is about to lift
    LIFTING = 3
    LANDING = 4  # until the ground is felt
    LOADING = 5  # of the foot that has landed
    DOUBLE = 6  # both feet stand


# What follows what, and when: the machine as docs/walking.md draws it.
TRANSITIONS = (
    (State.WAITING, "at stepping.start", State.LEANING),
    (State.LEANING, "fast enough to reverse on the stance foot", State.UNLOADING),
    (State.UNLOADING, "after timing.transition", State.LIFTING),
    (State.LIFTING, "after timing.lifting; at 70 % the next foot is planned", State.LANDING),
    (State.LANDING, "ground felt", State.LOADING),
    (State.LOADING, "after timing.loading", State.DOUBLE),
    (State.DOUBLE, "after timing.dual_support: the other foot's turn", State.UNLOADING),
)


def diagram() -> str:
    """The state machine in Mermaid's notation."""
    lines = [f"    {before.name} --> {after.name}: {when}" for before, when, after in TRANSITIONS]
    return "\n".join(["stateDiagram-v2", f"    [*] --> {State.WAITING.name}", *lines])


class Step:
    """Steps in place or towards a goal."""

    def __init__(self, workspace: Workspace, compile: Compile) -> None:
        config, model, robot = workspace.config, workspace.model, workspace.robot
        self._space, self._config, self._stepping = workspace, config, config.stepping
        self._n = n = len(robot.joints)
        self._dt = 1.0 / config.rate
        self._weight = robot.mass * robot.gravity
        own = self.fields(robot)
        self.telemetry = np.zeros(len(own))
        self._torque_at = own.index(f"torque_command.{robot.joint_names[0]}")
        self._height_at = own.index("com_reference.z")
        self.telemetry[own.index("internal_force")] = math.nan  # is not sensed
        self.torque = self.telemetry[self._torque_at : self._torque_at + n]
        self.memory, self.memory_next = np.zeros(4 + n), np.zeros(4 + n)
        self.setpoints = Setpoints(n, Mode.TORQUE, GainSet.STANCE)
        self._legs = [[k for k in range(n) if _leg(robot, k) == foot.name] for foot in robot.feet]

        gains = self._stepping.gains
        self._gains_of = {
            False: gains.double(self._dt), True: gains.single(self._dt)
        }  # fmt: skip
        self._seen = np.zeros(sum(OBSERVED.values()))
        self._see = items(self._seen)
        self._law_torque = np.zeros(n)
        self._anchor, self._push = np.zeros(3), np.zeros(3)
        self._integral, self._integral_next = np.zeros(8), np.zeros(8)
        self._reference, self._gains = np.zeros((3, 8), order="F"), np.zeros((3, 8), order="F")
        columns = self._reference.T.reshape(-1)  # of the same memory
        self._refer_foot = partial(struct.Struct("9d").pack_into, columns.data, columns.itemsize * 3 * _FOOT)
        self._integrate = np.zeros(1)
        inputs = {
            **model.sources, "counts": workspace.counts, "q": workspace.q, "v": workspace.v,
            "anchor": self._anchor, "integral": self._integral, "reference": self._reference, "gains": self._gains,
            "integrate": self._integrate, "push": self._push,
        }  # fmt: skip
        outputs = {"torque": self._law_torque, "observed": self._seen, "integral_next": self._integral_next}
        self._laws = {
            stance: Bound(compile(stepping(model, stance)), inputs, outputs) for stance in (None, 0, 1)
        }
        self._held = np.zeros(n)
        self._running = False

        self._state, self._since = State.WAITING, 0.0
        self._stance: int | None = None  # foot that carries alone; None: both
        self._swing: int = self._stepping.first
        self._footholds: Footholds | None = None  # from the take-over on
        self._landed_force = np.zeros(3)  # of the foot that lifts or lands, in double support
        self._planned: Plan | None = None
        self._departed = False  # the swing foot, sideways
        self._landing = 0.0  # s, planned length
        self._steps = 0
        self._lean = (0.0, 0.0)  # acceleration, duration
        self._swing_path = SwingTrajectory(self._stepping.swing)
        self._arrange()

    @staticmethod
    def fields(robot: Robot) -> list[str]:
        """Names of ``telemetry``, in order."""
        names = [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
        names += ["com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference"]
        names += ["internal_force", "internal_force_reference"]
        for what in ("torque_command", "torque_sensed", "q", "dq"):
            names += [f"{what}.{j}" for j in robot.joint_names]
        names += ["state", "steps"]
        feet = [foot.name for foot in robot.feet]
        names += [f"carries.{foot}" for foot in feet]
        names += [f"{what}.{foot}.{axis}" for what in ("foot", "felt") for foot in feet for axis in "xyz"]
        names += [f"swing_reference.{axis}" for axis in "xyz"]
        names += [f"pendulum.{what}" for what in ("x", "y", "vx", "vy")]
        names += [f"plan.{what}" for what in ("foot.x", "foot.y", "x", "y", "vx", "vy", "remaining", "extension")]
        return names

    # --- the tick ---------------------------------------------------------------------------------------------

    def act(self, phase: Phase, now_ns: int, since_ns: int) -> None:
        now = now_ns * 1e-9
        if not self._running:  # hanging: the anchor keeps the feet's middle at the origin
            self._reference[0, :] = 0.0
            self._laws[None]()
            self._observe()
            self.telemetry[self._height_at] = math.nan  # nothing is wanted yet
            return
        if phase is Phase.ON:
            self._advance(now)
        self._refer(now)
        self._laws[self._stance]()
        self._integral[:] = self._integral_next
        self._observe()
        self._follow()
        share = 1.0 if phase is Phase.ON else ramp(self._config.weight_ramp, self._config.rate, now_ns - since_ns)
        self._integrate[0] = phase is Phase.ON
        np.subtract(self._law_torque, self._held, out=self.torque)
        if share != 1.0:
            self.torque *= share
        self.torque += self._held

    def take_over(self) -> None:
        seen, space = self._seen, self._space
        self._held[:] = space.counts[2 * self._n :] * messages.NEWTON_METRE
        com, ground = seen[_COM].tolist(), float(seen[_FEET][2] + seen[_FEET][5]) / 2
        self._gains[:] = self._gains_of[False]
        config = self._config
        self._footholds = Footholds(self._stepping, space.robot, config.rate, config.blocks or (), com, ground)
        if self._stepping.hold_abduction:
            self._hold_out_of_plane()
        self._running = True

    def _hold_out_of_plane(self) -> None:
        """The drives hold the joints that do not turn about y where they are."""
        self.setpoints.positions = (self._space.counts[: self._n] * messages.RADIAN).tolist()
        for k, joint in enumerate(self._space.robot.joints):
            if abs(joint.axis[1]) < _SAGITTAL:
                self.setpoints.modes[k] = Mode.POSITION

    # --- the state machine ------------------------------------------------------------------------------------

    def _enter(self, state: State, now: float) -> None:
        self._state, self._since = state, now

    def _advance(self, now: float) -> None:
        """Enter the next state when this one has done its work: TRANSITIONS."""
        state, timing, elapsed = self._state, self._stepping.timing, now - self._since
        footholds = self._footholds
        assert footholds is not None
        if state is State.WAITING:
            if now >= self._stepping.start:
                feet, com = self._feet(), self._com()
                self._lean = footholds.launch(com[1], feet[1 - self._swing].y)
                footholds.stand(com, feet)
                self._enter(State.LEANING, now)
        elif state is State.LEANING:
            if elapsed >= self._lean[1]:
                self._unload(now)
        elif state is State.UNLOADING:
            if elapsed >= timing.transition:
                self._push[:] = 0.0
                step_up = footholds.step_up(now, self._swing, self._feet(), self._com())
                self._swing_path.lift(now, self._feet()[self._swing], timing.lifting, step_up)
                self._set_gains(self._swing, GainSet.SWING)
                self._planned, self._departed = None, False
                self._enter(State.LIFTING, now)
        elif state is State.LIFTING:
            self._aim(now, elapsed)
            if elapsed >= timing.lifting:
                assert self._planned is not None
                self._landing = timing.landing + self._planned.extension
                self._swing_path.land(now, self._planned.foot, self._landing)
                self._enter(State.LANDING, now)
        elif state is State.LANDING:
            landed = self._space.contacts[self._swing] and elapsed >= _LANDED_AFTER * self._landing
            if landed:
                self._load(now)
        elif state is State.LOADING:
            if elapsed >= timing.loading:
                self._stand_on(None)
                self._enter(State.DOUBLE, now)
        elif elapsed >= timing.dual_support:
            self._swing = 1 - self._swing
            self._unload(now)

    def _aim(self, now: float, elapsed: float) -> None:
        """Plan while the foot lifts, and once it may depart go where the newest plan says."""
        stepping, lifting = self._stepping, self._stepping.timing.lifting
        departs, left = elapsed >= stepping.swing.depart * lifting, lifting - elapsed + stepping.timing.landing
        new = self._planned
        if self._planned is None and elapsed >= stepping.planner.replan_at * lifting:
            new = self._planned = self._plan(now, left)
        elif self._departed:
            return
        elif departs and new is None:
            new = self._plan(now, left)
        if departs and new is not None:
            self._swing_path.aim(now, new.foot, left + new.extension)
            self._departed = True

    def _unload(self, now: float) -> None:
        """Single support from now on; the other foot still presses as in double support, and fades."""
        self._landed_force[:] = self._seen[_REACTION][3 * self._swing : 3 * self._swing + 3]
        self._stand_on(1 - self._swing)
        self._integral[_FOOT:] = 0.0
        self._hold_foot()
        self._enter(State.UNLOADING, now)

    def _load(self, now: float) -> None:
        """The foot has met the ground: what it would press with in double support grows from nothing."""
        stance = self._stance
        self._steps += 1
        assert self._footholds is not None
        self._footholds.landed(self._swing, self._feet()[self._swing].z)
        self._stand_on(None)
        self._reference_of_body(now)
        self._laws[None]()
        self._landed_force[:] = self._seen[_REACTION][3 * self._swing : 3 * self._swing + 3]
        self._stand_on(stance)
        self._set_gains(self._swing, GainSet.STANCE)
        self._hold_foot()
        self._enter(State.LOADING, now)

    def _stand_on(self, stance: int | None) -> None:
        """The feet that the robot's place is known by: one, or both."""
        feet = self._seen[_FEET]
        self._anchor[:] = (feet[:3] + feet[3:]) / 2 if stance is None else feet[3 * stance : 3 * stance + 3]
        assert self._footholds is not None
        levels = self._footholds.levels  # or the errors of all steps would add up
        self._anchor[2] = sum(levels) / len(levels) if stance is None else levels[stance]
        self._stance = stance
        self._gains[:] = self._gains_of[stance is not None]
        if self._steps:  # no feedback: 1 N sideways at this height takes 5 N from a foot that carries little yet
            self._gains[:, _COM_Y] = 0.0

    # --- references -------------------------------------------------------------------------------------------

    def _refer(self, now: float) -> None:
        self._reference_of_body(now)
        state, timing = self._state, self._stepping.timing
        if state is State.UNLOADING:
            self._push[:] = self._landed_force * max(0.0, 1.0 - (now - self._since) / max(timing.transition, self._dt))
        elif state is State.LOADING:
            self._push[:] = self._landed_force * min(1.0, (now - self._since) / max(timing.loading, self._dt))
        elif state in (State.LIFTING, State.LANDING):
            x, y, z, vx, vy, vz, ax, ay, az = self._swing_path.at(now)
            self._refer_foot(x, vx, ax, y, vy, ay, z, vz, az)
        if not self._stepping.transition:
            self._push *= 0.0

    def _reference_of_body(self, now: float) -> None:
        reference, footholds = self._reference, self._footholds
        assert footholds is not None
        reference[:, :_FOOT] = 0.0
        if footholds.level:
            reference[0, _COM_Z] = footholds.height
        else:
            reference[:, _COM_Z] = footholds.height_reference(self._feet()[1 - self._swing])
        yaw, limit = self._see[_RPY.start + 2], self._stepping.yaw_error_limit
        reference[0, _YAW] = yaw - min(limit, max(-limit, yaw))
        t = now - self._since
        if self._state is State.LEANING:
            a = self._lean[0]
            reference[:, _COM_Y] = footholds.middle[1] + a * t * t / 2, a * t, a
        elif self._stance is None and self._state is State.WAITING:
            reference[0, _COM_Y] = footholds.middle[1]
        else:
            reference[2, _COM_Y] = self._falling(footholds)

    def _falling(self, footholds: Footholds) -> float:
        """Lateral acceleration [m/s²] of the pendulum on a point midway between the feet: each carries half, also when
        the centre of mass is not between them, and a foot that has landed is not asked to pull. 0 where y is held."""
        if not self._stepping.gains.double_support.com_y.kp:
            return 0.0
        see, feet = self._see, _FEET.start
        middle = (see[feet + 1] + see[feet + 4]) / 2
        return footholds.falling(see[_COM.start + 1] - middle)

    def _hold_foot(self) -> None:
        """The swing foot shall stay where it is."""
        self._reference[:, _FOOT:] = 0.0
        self._reference[0, _FOOT:] = self._seen[_FEET][3 * self._swing : 3 * self._swing + 3]

    def _set_gains(self, foot: int, gain_set: int) -> None:
        for joint in self._legs[foot]:
            self.setpoints.gain_sets[joint] = gain_set

    def _feet(self) -> list[Foot]:
        feet = self._seen[_FEET].tolist()
        return [Foot(*feet[:3]), Foot(*feet[3:])]

    def _com(self) -> list[float]:
        return self._seen[_COM].tolist()

    def _plan(self, now: float, to_touchdown: float) -> Plan:
        """Where the swing foot shall land, ``to_touchdown`` [s] from ``now``."""
        assert self._footholds is not None
        return self._footholds.plan(now, to_touchdown, self._swing, self._feet(), self._com())

    def _follow(self) -> None:
        """The pendulum observer's share of this tick."""
        assert self._footholds is not None
        observer, seen = self._footholds.observer, self._seen
        feet = seen[_FEET].tolist()
        if self._stance is None:
            x, y = (feet[0] + feet[3]) / 2, (feet[1] + feet[4]) / 2
        else:
            s, o = 3 * self._stance, 3 * (1 - self._stance)
            share = min(1.0, max(0.0, -float(self._push[2]) / self._weight))
            x, y = feet[s] + share * (feet[o] - feet[s]), feet[s + 1] + share * (feet[o + 1] - feet[s + 1])
        com, velocity = seen[_COM].tolist(), seen[_COM_VELOCITY].tolist()
        if self._state in (State.WAITING, State.LEANING):
            observer.reset(com[0], com[1], velocity[0], velocity[1])
            return
        observer.predict(x, y)
        observer.correct(com[0], com[1], velocity[0], velocity[1])

    # --- telemetry --------------------------------------------------------------------------------------------

    def _arrange(self) -> None:
        """What the telemetry is put together from, every tick: around the torques, which are written where they lie."""
        space, n, seen, reference = self._space, self._n, self._seen, self._reference
        self._sensed_torque, self._counted_torque = np.zeros(n), space.counts[2 * n :]
        self._progress = np.zeros(4)  # state, steps, which feet carry
        self._foreseen = np.zeros(12)  # the pendulum, and the last plan
        before = (seen[:6], seen[:1], reference[0, _COM_Z : _COM_Z + 1], seen[_RPY])
        behind = (
            self._sensed_torque, space.q[7:], space.v[6:], self._progress, seen[_FEET], seen[_FELT],
            reference[0, _FOOT:], self._foreseen,
        )  # fmt: skip
        self._parts = (before, self.telemetry[:11]), (behind, self.telemetry[self._torque_at + n :])
        self._told: Plan | None = None  # the plan that is in ``_foreseen``

    def _observe(self) -> None:
        self.memory_next[:4] = self._space.q[3:7]
        self.memory_next[4:] = self._space.v[6:]
        np.multiply(self._counted_torque, messages.NEWTON_METRE, out=self._sensed_torque)
        self._progress[:] = self._state, self._steps, self._stance != 1, self._stance != 0
        plan = self._planned
        if self._footholds is not None:
            observer = self._footholds.observer
            self._foreseen[:4] = observer.x, observer.y, observer.vx, observer.vy
        if plan is not None and plan is not self._told:
            self._told = plan
            self._foreseen[4:] = (
                plan.foot.x, plan.foot.y, plan.switching.x, plan.switching.y, plan.switching.vx, plan.switching.vy,
                plan.remaining, plan.extension,
            )  # fmt: skip
        for parts, place in self._parts:
            np.concatenate(parts, out=place)

    # --- state ------------------------------------------------------------------------------------------------

    _ARRAYS = (
        "telemetry", "_seen", "_law_torque", "_anchor", "_push", "_integral", "_reference", "_gains", "_integrate",
        "_held", "_landed_force",
    )  # fmt: skip
    _PLAIN = (
        "_running", "_state", "_since", "_stance", "_swing", "_planned", "_departed", "_landing", "_steps", "_lean",
    )  # fmt: skip

    def snapshot(self) -> Any:
        return {
            **{name: getattr(self, name).copy() for name in self._ARRAYS},
            **{name: getattr(self, name) for name in self._PLAIN},
            "gain_sets": list(self.setpoints.gain_sets),
            "modes": list(self.setpoints.modes),
            "positions": self.setpoints.positions,
            "swing_path": self._swing_path.snapshot(),
            "footholds": None if self._footholds is None else (self._footholds, self._footholds.snapshot()),
        }

    def restore(self, state: Any) -> None:
        for name in self._ARRAYS:
            getattr(self, name)[:] = state[name]
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self._foreseen[:], self._told = self.telemetry[-len(self._foreseen) :], None
        self.setpoints.gain_sets[:] = state["gain_sets"]
        self.setpoints.modes[:] = state["modes"]
        self.setpoints.positions = state["positions"]
        self._swing_path.restore(state["swing_path"])
        self._footholds = None
        if state["footholds"] is not None:
            self._footholds, own = state["footholds"]
            self._footholds.restore(own)


def _leg(robot: Robot, joint: int) -> str:
    """Name of the foot at the end of the leg that has this joint."""
    names = robot.joint_names
    for foot in robot.feet:
        name = foot.joint
        while name != robot.base.name:
            if name == names[joint]:
                return foot.name
            name = robot.joints[names.index(name)].parent
    return ""
