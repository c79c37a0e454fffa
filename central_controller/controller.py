"""The central controller's node: measurements in, one command per bus out, at its servo rate."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np

from bus import messages
from bus.messages import Controlword, GainSet, Mode, Setpoint, State, Statusword
from central_controller.config import ControllerConfig
from central_controller.estimator import BaseEstimator
from central_controller.model import RobotModel
from central_controller.path import offset
from central_controller.tasks import TaskFeedback
from central_controller.wbosc import whole_body_control
from robots import imu
from robots.description import Robot

IMU_SOURCE = 255


class Phase(IntEnum):
    """What the controller is doing, in order."""

    OFF = 0  # waiting for the first measurements
    ENABLING = 1  # walking the drives through their states
    RAMP = 2  # torques grow from nothing
    ON = 3


_NEXT_CONTROLWORD = {
    Statusword.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    Statusword.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    Statusword.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    Statusword.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
}


def telemetry_fields(robot: Robot) -> list[str]:
    """Names of the controller's telemetry, in order."""
    names = [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
    names += ["com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference"]
    names += ["internal_force", "internal_force_reference"]
    names += [f"{what}.{j}" for what in ("torque_command", "torque_sensed", "q", "dq") for j in robot.joint_names]
    return [*names, "state_age", "phase", "missed_states", "malformed"]


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
        self._imu = robot.imu
        names = robot.joint_names
        self._joint_of = {messages.STATE + joint.node_id: names.index(joint.name) for joint in robot.joints}
        self._buses = [[names.index(name) for name in bus.joints] for bus in robot.buses]
        self._dt = 1.0 / config.rate
        self.model = RobotModel(robot)
        self._estimator = BaseEstimator(self.model, config)
        self._feedback = TaskFeedback(config.tasks, self._dt)
        self._u, self._line = np.zeros(4), np.zeros(3)
        self._force_reference = np.array([config.internal_force.reference])
        gain = config.internal_force.gain if config.internal_force.feedback else 0.0
        self._force_gain = np.array([gain])
        self._torque, self._reaction, self._internal = np.zeros(n), np.zeros(6), np.zeros(1)
        self._position, self._velocity, self._sensed = np.zeros(n), np.zeros(n), np.zeros(n)
        self._bind(compile(whole_body_control(2, 4)))

        self.telemetry = np.zeros(len(telemetry_fields(robot)))
        self._states: list[State | None] = [None] * n
        self._arrivals = [0] * n
        self._fresh = [False] * n  # whether a state came since the last tick
        self._gyro, self._force = np.zeros(3), np.zeros(3)
        self._imu_seen = False
        self._phase = Phase.OFF
        self._since_ns = 0  # start of the phase
        self._reference = np.zeros((3, 4))
        self._start = np.zeros(4)  # task values captured when the drives were on
        self._counter = 0
        self._missed = 0
        self._malformed = 0

    def _bind(self, function: ca.Function) -> None:
        model = self.model
        self._buffer, self._evaluate = function.buffer()
        arguments = (
            model.A, model.h, model.Js, model.Jsdot_dq, model.Jt, model.Jtdot_dq, self._u, self._line,
            self._force_reference, self._force_gain, self._sensed,
        )  # fmt: skip
        for index, array in enumerate(arguments):
            self._buffer.set_arg(index, memoryview(array.T.reshape(-1)))  # a view: the matrices are column-major
        for index, array in enumerate((self._torque, self._reaction, self._internal)):
            self._buffer.set_res(index, memoryview(array))

    # --- measurements ---------------------------------------------------------------------------------------------

    def receive(self, arrival_ns: int, source: int, can_id: int, data: bytes) -> None:
        """Take one measurement: a drive's frame of bus ``source``, or the IMU's sample. Malformed ones are counted."""
        try:
            if source == IMU_SOURCE:
                self._gyro, self._force = imu.decode(data, self._imu)
                self._imu_seen = True
                return
            joint = self._joint_of.get(can_id)
            if joint is None:
                return  # an emergency: the statusword of the next state tells the same
            state = messages.decode_state(data)
        except ValueError:
            self._malformed += 1
            return
        known = self._states[joint]
        if known is not None and not messages.newer(state.counter, known.counter):
            return
        self._states[joint] = state
        self._arrivals[joint] = arrival_ns
        self._fresh[joint] = True
        self._position[joint] = state.position
        self._velocity[joint] = state.velocity
        self._sensed[joint] = state.torque

    # --- the servo tick -------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[tuple[int, int, bytes]]:
        """One servo cycle. Returns (bus, identifier, payload) of each command."""
        if self._phase != Phase.OFF:
            self._missed += self._fresh.count(False)
        self._fresh = [False] * self._n
        complete = self._imu_seen and None not in self._states
        if not complete:
            return self._commands(now_ns, active=False)
        if self._phase == Phase.OFF and now_ns * 1e-9 >= self._config.enable_at:
            self._enter(Phase.ENABLING, now_ns)
        if self._phase == Phase.OFF:
            self._estimator.hang(self._gyro, self._force)
            self._estimator.place(self._position, self._velocity)
            return self._commands(now_ns, active=False)
        self._estimator.turn(self._gyro, self._force)
        self._estimator.place(self._position, self._velocity)
        self.model.update(self._estimator.q, self._estimator.v)
        if self._phase == Phase.ENABLING and all(
            s is not None and s.statusword & Statusword.MASK == Statusword.OPERATION_ENABLED for s in self._states
        ):
            self._start[:] = self.model.task
            self._start[2:] = 0.0  # the torso is to stand upright
            self._enter(Phase.RAMP, now_ns)
        self._control(now_ns)
        if self._phase == Phase.RAMP and now_ns - self._since_ns >= self._config.weight_ramp * 1e9:
            self._enter(Phase.ON, now_ns)
        return self._commands(now_ns, active=True)

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self._phase = phase
        self._since_ns = now_ns

    def _control(self, now_ns: int) -> None:
        model, reference = self.model, self._reference
        running = self._phase >= Phase.RAMP
        reference[:] = 0.0
        reference[0] = self._start if running else model.task
        if running:
            for column, (position, velocity, acceleration) in enumerate(offset(self._config.path, now_ns * 1e-9)):
                reference[0, column] += position
                reference[1, column] = velocity
                reference[2, column] = acceleration
        self._u[:] = self._feedback.acceleration(
            reference, model.task, model.task_velocity, self._phase == Phase.ON
        )
        line = model.feet[0] - model.feet[1]
        self._line[:] = line / math.sqrt(line @ line)
        self._evaluate()
        if self._phase == Phase.ENABLING:
            self._torque[:] = 0.0
        elif self._phase == Phase.RAMP:
            self._torque *= min((now_ns - self._since_ns) * 1e-9 / max(self._config.weight_ramp, self._dt), 1.0)

    def _commands(self, now_ns: int, active: bool) -> list[tuple[int, int, bytes]]:
        self._counter = (self._counter + 1) & 0xFFFF
        torques = self._torque.tolist()
        finite = all(map(math.isfinite, torques))
        mode = Mode.TORQUE if finite else Mode.DAMPING
        commands = []
        for bus, joints in enumerate(self._buses):
            setpoints = []
            for joint in joints:
                state = self._states[joint]
                if state is None or not active:
                    setpoints.append(Setpoint(state_counter=0 if state is None else state.counter))
                    continue
                word = _NEXT_CONTROLWORD.get(state.statusword & Statusword.MASK, Controlword.DISABLE_VOLTAGE)
                if self._phase >= Phase.RAMP and word != Controlword.ENABLE_OPERATION:
                    word = Controlword.DISABLE_VOLTAGE  # it dropped out: it is not brought back
                setpoints.append(Setpoint(
                    word, mode, GainSet.STANCE, torques[joint] if finite else 0.0, state.position, 0.0, 500.0,
                    state.counter,
                ))  # fmt: skip
            commands.append((bus, messages.COMMAND, messages.encode_command(self._counter, setpoints)))
        self._report(now_ns)
        return commands

    def _report(self, now_ns: int) -> None:
        row, model, n = self.telemetry, self.model, self._n
        row[0:3], row[3:6] = model.com, model.com_velocity
        row[6:8] = self._reference[0, :2]
        row[8:11] = model.rpy
        row[11], row[12] = self._reference[0, 3], self._reference[0, 2]
        row[13], row[14] = self._internal[0], self._force_reference[0]
        row[15 : 15 + n] = self._torque
        row[15 + n : 15 + 2 * n] = self._sensed
        row[15 + 2 * n : 15 + 3 * n] = self._position
        row[15 + 3 * n : 15 + 4 * n] = self._estimator.v[6:]
        row[-4] = (now_ns - min(self._arrivals)) * 1e-9
        row[-3], row[-2], row[-1] = self._phase, self._missed, self._malformed

    # --- state ----------------------------------------------------------------------------------------------------

    _PLAIN = ("_imu_seen", "_phase", "_since_ns", "_counter", "_missed", "_malformed")
    _ARRAYS = (
        "_u", "_line", "_torque", "_reaction", "_internal", "_position", "_velocity", "_sensed", "_gyro", "_force",
        "_reference", "_start", "telemetry",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            **{name: getattr(self, name).copy() for name in self._ARRAYS},
            "states": list(self._states),
            "fresh": list(self._fresh),
            "model": (self.model.com.copy(), self.model.com_velocity.copy(), self.model.rpy.copy()),
            "arrivals": list(self._arrivals),
            "estimator": self._estimator.snapshot(),
            "feedback": self._feedback.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        for name in self._ARRAYS:
            if name in ("_gyro", "_force"):
                setattr(self, name, state[name].copy())
            else:
                getattr(self, name)[:] = state[name]
        self._states = list(state["states"])
        self._fresh = list(state["fresh"])
        self._arrivals = list(state["arrivals"])
        self._estimator.restore(state["estimator"])
        self._feedback.restore(state["feedback"])
        # the telemetry shows the model; all else in it is computed anew before it is used
        model = self.model
        model.com[:], model.com_velocity[:], model.rpy[:] = state["model"]
