"""The central controller's node: measurements in, one command per bus out, at its servo rate."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np

from bus import messages
from bus.messages import Controlword, GainSet, Mode, Setpoint, State, Statusword
from central_controller.binding import Bound
from central_controller.config import ControllerConfig
from central_controller.estimator import Hanging, filter_constants
from central_controller.law import ORIENTATION, control, memory_size, predict
from central_controller.model import RobotModel
from central_controller.path import path_constants
from central_controller.tasks import task_gains
from robots import imu
from robots.description import Robot

IMU_SOURCE = 255
_FIELDS = len(State._fields)
_WORD, _POSITION, _VELOCITY, _TORQUE = map(State._fields.index, ("statusword", "position", "velocity", "torque"))
_RESYNC_NS = 50_000_000  # older states than the one known are ignored for no longer than this
_TORQUE_LIMIT = 500.0  # N m: the drives' own limits are lower


class Phase(IntEnum):
    """What the controller is doing, in order."""

    OFF = 0  # waiting for the first measurements
    ENABLING = 1  # walking the drives through their states; they hold the joints while the robot hangs still
    RAMP = 2  # from the torques that held the joints to those of the control law
    ON = 3


_MASK = Statusword.MASK
# Answers to a drive's state; to any other: off. While the robot stands, a drive that dropped out is not brought back.
_WHILE_ENABLING = {
    Statusword.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    Statusword.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    Statusword.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    Statusword.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
}
_WHILE_STANDING = {Statusword.OPERATION_ENABLED: Controlword.ENABLE_OPERATION}

_NODE_FIELDS = ("state_age", "phase", "missed_states", "malformed")  # not of the control law


def telemetry_fields(robot: Robot) -> list[str]:
    """Names of the controller's telemetry, in order."""
    names = [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
    names += ["com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference"]
    names += ["internal_force", "internal_force_reference"]
    names += [f"{what}.{j}" for what in ("torque_command", "torque_sensed", "q", "dq") for j in robot.joint_names]
    return [*names, *_NODE_FIELDS]


def _identity(function: ca.Function) -> ca.Function:
    return function


class Controller:
    """Whole-body control of a biped in double support, from drive states and the IMU."""

    def __init__(
        self,
        robot: Robot,
        config: ControllerConfig,
        compile: Callable[[ca.Function], ca.Function] = _identity,
    ) -> None:
        n = len(robot.joints)
        self._n = n
        self._config = config
        if robot.imu is None:
            raise ValueError(f"{robot.name} has no IMU to control it by")
        self._imu = robot.imu
        names = robot.joint_names
        self._joint_of = {messages.STATE + joint.node_id: names.index(joint.name) for joint in robot.joints}
        self._buses = [[names.index(name) for name in bus.joints] for bus in robot.buses]
        self._model = RobotModel(robot)
        self._hanging = Hanging(config.rate)

        # the memory that the compiled functions work in
        self.telemetry = np.zeros(len(telemetry_fields(robot)))
        self._torque, self._node_fields = self.telemetry[15 : 15 + n], self.telemetry[-len(_NODE_FIELDS) :]
        self._memory, self._memory_next = np.zeros(memory_size(n)), np.zeros(memory_size(n))
        self._memory[ORIENTATION] = self._hanging.quaternion
        self._gyro, self._force = np.zeros(3), np.zeros(3)
        self._counts = np.zeros(3 * n)  # positions, velocities, torques as the drives send them
        self._hold: tuple[int, ...] = (0,) * n  # counts: where the joints were at first
        self._start = np.zeros(2)  # centre of mass x, z when it began to stand
        self._held = np.zeros(n)  # torques then
        self._schedule = np.zeros(4)
        self._gains = task_gains(config.tasks, 1.0 / config.rate)
        self._q, self._v = np.zeros(self._model.nq), np.zeros(self._model.nv)
        self._bind(compile)
        self._unpack_states = struct.Struct("<" + messages.STATE_LAYOUT * n).unpack
        self._pack_counts = struct.Struct(f"{3 * n}d").pack_into

        self._states: list[bytes] = [b""] * n  # the last of each drive; empty: none yet
        self._counters = [0] * n  # of these
        self._arrivals = [0] * n
        self._fresh = [False] * n  # whether a state came since the last tick
        self._imu_seen = False
        self._phase = Phase.OFF
        self._since_ns = 0  # start of the phase
        self._counter = 0
        self._missed = 0
        self._malformed = 0

    def _bind(self, compile: Callable[[ca.Function], ca.Function]) -> None:
        config = self._config
        gain = config.internal_force.gain if config.internal_force.feedback else 0.0
        inputs = {
            **self._model.sources,
            "counts": self._counts, "gyro": self._gyro, "zero": self._hanging.zero, "force": self._force,
            "memory": self._memory, "q": self._q, "v": self._v,
            "start": self._start, "held": self._held, "schedule": self._schedule,
            "gains": self._gains, "path": path_constants(config.path), "filters": filter_constants(config),
            "internal_force": np.array([config.internal_force.reference, gain]),
        }  # fmt: skip
        law = self.telemetry[: -len(_NODE_FIELDS)]
        self._predict = Bound(compile(predict(self._n)), inputs, {"q": self._q, "v": self._v})
        self._control = Bound(
            compile(control(self._model)), inputs, {"telemetry": law, "memory_next": self._memory_next}
        )

    # --- measurements ---------------------------------------------------------------------------------------------

    def receive(self, arrival_ns: int, source: int, can_id: int, data: bytes) -> None:
        """Take one measurement: a drive's frame of bus ``source``, or the IMU's sample. Malformed ones are counted."""
        if source == IMU_SOURCE:
            try:
                self._gyro[:], self._force[:] = imu.decode(data, self._imu)
            except ValueError:
                self._malformed += 1
            else:
                self._imu_seen = True
            return
        joint = self._joint_of.get(can_id)
        if joint is None:
            return  # an emergency: the statusword of the next state tells the same
        if len(data) != messages.STATE_LENGTH:
            self._malformed += 1
            return
        counter = data[0] | data[1] << 8  # the layout's first field
        # Nothing newer for long: the drive's counter began anew, or the one known was wrong.
        recent = self._states[joint] and arrival_ns - self._arrivals[joint] < _RESYNC_NS
        if recent and not messages.newer(counter, self._counters[joint]):
            return
        self._states[joint] = data
        self._counters[joint] = counter
        self._arrivals[joint] = arrival_ns
        self._fresh[joint] = True

    # --- the servo tick -------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[tuple[int, int, bytes]]:
        """One servo cycle. Returns (bus, identifier, payload) of each command."""
        if self._phase is not Phase.OFF:
            self._missed += self._fresh.count(False)
        self._fresh = [False] * self._n
        if not self._imu_seen or b"" in self._states:
            return self._answer(now_ns, [Setpoint(state_counter=counter) for counter in self._counters])
        fields = self._unpack_states(b"".join(self._states))
        words, positions = fields[_WORD::_FIELDS], fields[_POSITION::_FIELDS]
        if self._phase is Phase.OFF:
            self._hold = positions
            self._enter(Phase.ENABLING, now_ns)
        self._pack_counts(self._counts.data, 0, *positions, *fields[_VELOCITY::_FIELDS], *fields[_TORQUE::_FIELDS])
        self._predict()
        if self._phase is Phase.ENABLING:
            self._hanging.take(self._gyro, self._force)
            self._q[3:7], self._v[3:6] = self._hanging.quaternion, 0.0
        self._model.compute(self._q, self._v)
        self._plan(now_ns)
        self._control()
        self._memory[:] = self._memory_next
        setpoints = self._setpoints(words, positions)
        self._advance(words, now_ns)
        return self._answer(now_ns, setpoints)

    def _plan(self, now_ns: int) -> None:
        """What the control law is to do at this time of this phase."""
        phase, schedule = self._phase, self._schedule
        if phase is Phase.ON:  # the path begins no earlier, or its reference would jump
            schedule[3] = now_ns * 1e-9 - max(self._config.path.start, self._since_ns * 1e-9)
        elif phase is Phase.RAMP:
            ramp = max(self._config.weight_ramp, 1.0 / self._config.rate)
            schedule[2] = min((now_ns - self._since_ns) * 1e-9 / ramp, 1.0)

    def _advance(self, words: tuple[int, ...], now_ns: int) -> None:
        """Enter the next phase when this one has done its work."""
        if self._phase is Phase.ENABLING:
            if now_ns * 1e-9 >= self._config.stand_at and all(
                word & _MASK == Statusword.OPERATION_ENABLED for word in words
            ):
                self._start[:] = self.telemetry[0:3:2]
                self._held[:] = self._counts[2 * self._n :] * messages.NEWTON_METRE
                self._enter(Phase.RAMP, now_ns)
                self._schedule[0] = 1.0
        elif self._phase is Phase.RAMP and now_ns - self._since_ns >= self._config.weight_ramp * 1e9:
            self._enter(Phase.ON, now_ns)
            self._schedule[1:3] = 1.0

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self._phase = phase
        self._since_ns = now_ns

    def _setpoints(self, words: tuple[int, ...], positions: tuple[int, ...]) -> list[Setpoint]:
        """One set-point per joint, from the statuswords and positions (counts) of the drives."""
        mode = Mode.TORQUE
        if self._phase < Phase.RAMP:
            mode, positions = Mode.POSITION, self._hold
            self._torque[:] = 0.0
        torques = self._torque.tolist()
        if not math.isfinite(sum(torques)):
            mode, torques = Mode.DAMPING, [0.0] * self._n
        answers = _WHILE_STANDING if self._phase >= Phase.RAMP else _WHILE_ENABLING
        answer, off, gains, radian = answers.get, Controlword.DISABLE_VOLTAGE, GainSet.STANCE, messages.RADIAN
        return [
            Setpoint(answer(word & _MASK, off), mode, gains, torque, position * radian, 0.0, _TORQUE_LIMIT, counter)
            for word, torque, position, counter in zip(words, torques, positions, self._counters, strict=True)
        ]

    def _answer(self, now_ns: int, setpoints: list[Setpoint]) -> list[tuple[int, int, bytes]]:
        self._counter = counter = (self._counter + 1) & 0xFFFF
        self._node_fields[:] = (now_ns - min(self._arrivals)) * 1e-9, self._phase, self._missed, self._malformed
        return [
            (bus, messages.COMMAND, messages.encode_command(counter, [setpoints[joint] for joint in joints]))
            for bus, joints in enumerate(self._buses)
        ]

    # --- state ----------------------------------------------------------------------------------------------------

    _PLAIN = ("_imu_seen", "_phase", "_hold", "_since_ns", "_counter", "_missed", "_malformed")
    _LISTS = ("_states", "_counters", "_arrivals", "_fresh")
    _ARRAYS = ("telemetry", "_memory", "_gyro", "_force", "_start", "_held", "_schedule")  # all else is computed anew

    def snapshot(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            **{name: getattr(self, name).copy() for name in (*self._LISTS, *self._ARRAYS)},
            "hanging": self._hanging.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        for name in (*self._LISTS, *self._ARRAYS):
            getattr(self, name)[:] = state[name]  # in place: the compiled functions are bound to the arrays
        self._hanging.restore(state["hanging"])
