"""The central controller's node: measurements in, one command per bus out, at its servo rate."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from bus import messages
from bus.messages import Controlword, GainSet, Mode, Setpoint, Slot, State, Statusword
from central_controller.behaviours import behaviour_class
from central_controller.behaviours.behaviour import Behaviour, Phase, Workspace
from central_controller.binding import Bound, items
from central_controller.config import ControllerConfig
from central_controller.estimation import contact
from central_controller.estimation.motion_capture import FIELDS, MotionCaptureOrientation
from central_controller.estimator import Hanging, filter_constants
from central_controller.law import ORIENTATION, estimate, predict
from central_controller.model import RobotModel
from robots import imu, motion_capture
from robots.description import Robot

IMU_SOURCE = 255
MOTION_CAPTURE_SOURCE = 254
_FIELDS = len(State._fields)
_WORD, _POSITION, _VELOCITY, _TORQUE = map(State._fields.index, ("statusword", "position", "velocity", "torque"))
_RESYNC_NS = 50_000_000  # older states than the one known are ignored for no longer than this
_TORQUE_LIMIT = 500.0  # N m: the drives' own limits are lower


_MASK = Statusword.MASK
# Answers to a drive's state; to any other: off. While the robot stands, a drive that dropped out is not brought back.
_WHILE_ENABLING = {
    Statusword.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    Statusword.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    Statusword.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    Statusword.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
}
_WHILE_STANDING = {Statusword.OPERATION_ENABLED: Controlword.ENABLE_OPERATION}

_NODE_FIELDS = ("state_age", "phase", "missed_states", "malformed")  # not of the behaviour


def telemetry_fields(robot: Robot, config: ControllerConfig) -> list[str]:
    """Names of the controller's telemetry, in order."""
    orientation = FIELDS if config.orientation == "motion_capture" else ()
    touch = contact.fields(robot) if config.contact != "switch" else ()
    return [*behaviour_class(config.behaviour).fields(robot), *orientation, *touch, *_NODE_FIELDS]


def _identity(function: ca.Function) -> ca.Function:
    return function


class Controller:
    """The node: drive states, the IMU and motion capture in, what ``config.behaviour`` makes of them out."""

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
        self._resolution = imu.resolutions(robot.imu)
        self._motion = np.zeros(6)  # of the IMU: gyro, force
        names = robot.joint_names
        self._joint_of = {messages.STATE + joint.node_id: names.index(joint.name) for joint in robot.joints}
        self._buses = [[names.index(name) for name in bus.joints] for bus in robot.buses]
        self._knees = [names.index(foot.joint) for foot in robot.feet]  # whose drives read the feet's switches
        self._hanging = Hanging(config.rate)

        # the memory that the compiled functions work in
        model = self._model = RobotModel(robot)
        self._space = space = Workspace(
            robot, config, model, counts=np.zeros(3 * n), gyro=self._motion[:3], force=self._motion[3:],
            contacts=np.zeros(len(robot.feet)), q=np.zeros(model.nq), v=np.zeros(model.nv),
        )  # fmt: skip
        self._behaviour: Behaviour = behaviour_class(config.behaviour)(space, compile)
        self._memory = self._behaviour.memory
        self._memory[ORIENTATION] = self._hanging.quaternion
        self.telemetry = np.zeros(len(telemetry_fields(robot, config)))
        self._predict = Bound(
            compile(predict(n)),
            {
                "counts": space.counts, "gyro": space.gyro, "zero": self._hanging.zero, "force": space.force,
                "estimate": self._memory[estimate(n)], "filters": filter_constants(config),
            },
            {"q": space.q, "v": space.v},
        )  # fmt: skip
        self._cameras = robot.motion_capture
        self._frames: list[motion_capture.Frame] = []  # since the last tick
        self._orientation: MotionCaptureOrientation | None = None  # None: that of ``predict``
        if config.orientation == "motion_capture":
            self._orientation = MotionCaptureOrientation(robot, config.motion_capture, compile)
        self._contact: contact.Contact | None = None  # None: the switches tell
        if config.contact != "switch":
            self._contact = contact.Contact(space, self._hanging.zero, compile)
        self._phase_ns = round(config.phase * 1e9)
        self._hold: tuple[int, ...] = (0,) * n  # counts: where the joints were at first
        self._unpack_states = struct.Struct("<" + messages.STATE_LAYOUT * n).unpack
        self._pack_counts = partial(struct.Struct(f"{3 * n}d").pack_into, space.counts.data, 0)
        self._contacts = items(space.contacts)
        self._own = items(self.telemetry[len(self.telemetry) - len(_NODE_FIELDS) :])
        self._limits = [_TORQUE_LIMIT] * n

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

    # --- measurements ---------------------------------------------------------------------------------------------

    def receive(self, arrival_ns: int, source: int, can_id: int, data: bytes) -> None:
        """Take one measurement: a drive's frame of bus ``source``, the IMU's sample or a frame of motion capture.
        Malformed ones are counted."""
        if source == IMU_SOURCE:
            try:
                self._motion[:] = imu.unpack(data, self._resolution)
            except ValueError:
                self._malformed += 1
            else:
                self._imu_seen = True
            return
        if source == MOTION_CAPTURE_SOURCE:
            if self._cameras is not None:
                try:
                    self._frames.append(motion_capture.decode(data, self._cameras))
                except motion_capture.MalformedFrameError:
                    self._malformed += 1
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
            self._frames.clear()
            return self._answer(now_ns, [Setpoint(state_counter=counter) for counter in self._counters])
        fields = self._unpack_states(b"".join(self._states))
        words, positions = fields[_WORD::_FIELDS], fields[_POSITION::_FIELDS]
        if self._phase is Phase.OFF:
            self._hold = positions
            self._enter(Phase.ENABLING, now_ns)
        space, behaviour = self._space, self._behaviour
        self._pack_counts(*positions, *fields[_VELOCITY::_FIELDS], *fields[_TORQUE::_FIELDS])
        for foot, knee in enumerate(self._knees):
            self._contacts[foot] = words[knee] & Statusword.FOOT_CONTACT != 0
        self._predict()
        if self._orientation is not None:
            self._orient(self._orientation, now_ns)
        self._frames.clear()
        if self._phase is Phase.ENABLING:
            self._hanging.take(space.gyro, space.force)
            space.q[3:7], space.v[3:6] = self._hanging.quaternion, 0.0
        self._model.compute(space.q, space.v)
        if self._contact is not None:
            self._contact.tell()
        behaviour.act(self._phase, now_ns, self._since_ns)
        self._memory[:] = behaviour.memory_next
        setpoints = self._setpoints(words, positions)
        self._advance(words, now_ns)
        return self._answer(now_ns, setpoints)

    def _orient(self, orientation: MotionCaptureOrientation, now_ns: int) -> None:
        """Let ``orientation`` tell in place of the complementary filter how the torso stands and turns."""
        space = self._space
        if self._phase is Phase.ENABLING:
            orientation.hang(self._hanging.quaternion, self._hanging.zero)
        orientation.take_imu(space.gyro, now_ns - self._phase_ns)  # sampled so long before the tick
        for frame in self._frames:
            orientation.take_frame(frame)
        orientation.tell()
        space.q[3:7], space.v[3:6] = orientation.quaternion, orientation.rate

    def _advance(self, words: tuple[int, ...], now_ns: int) -> None:
        """Enter the next phase when this one has done its work."""
        if self._phase is Phase.ENABLING:
            if now_ns * 1e-9 >= self._config.stand_at and all(
                word & _MASK == Statusword.OPERATION_ENABLED for word in words
            ):
                self._behaviour.take_over()
                self._enter(Phase.RAMP, now_ns)
        elif self._phase is Phase.RAMP and now_ns - self._since_ns >= self._config.weight_ramp * 1e9:
            self._enter(Phase.ON, now_ns)

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self._phase = phase
        self._since_ns = now_ns

    def _setpoints(self, words: tuple[int, ...], positions: tuple[int, ...]) -> list[Slot]:
        """One set-point per joint, from the statuswords and positions (counts) of the drives."""
        behaviour, n = self._behaviour, self._n
        if self._phase < Phase.RAMP:
            behaviour.torque[:] = 0.0
            modes, gain_sets = [Mode.POSITION] * n, [GainSet.STANCE] * n
            positions, wanted, speeds = self._hold, None, [0.0] * n
        else:
            own = behaviour.setpoints
            modes, gain_sets, wanted, speeds = own.modes, own.gain_sets, own.positions, own.velocities
        if wanted is None:
            wanted = [position * messages.RADIAN for position in positions]
        torques = behaviour.torque.tolist()
        if not math.isfinite(sum(torques)):
            modes, torques = [Mode.DAMPING] * n, [0.0] * n
        answers = _WHILE_STANDING if self._phase >= Phase.RAMP else _WHILE_ENABLING
        answer, off = answers.get, Controlword.DISABLE_VOLTAGE
        controlwords = [answer(word & _MASK, off) for word in words]
        limits, counters = self._limits, self._counters
        return list(zip(controlwords, modes, gain_sets, torques, wanted, speeds, limits, counters, strict=True))

    def _answer(self, now_ns: int, setpoints: Sequence[Slot]) -> list[tuple[int, int, bytes]]:
        self._counter = counter = (self._counter + 1) & 0xFFFF
        behaviour = self._behaviour.telemetry
        at = len(behaviour)
        self.telemetry[:at] = behaviour
        for part in (self._orientation, self._contact):
            if part is not None:
                self.telemetry[at : at + len(part.telemetry)] = part.telemetry
                at += len(part.telemetry)
        own = self._own
        own[0] = (now_ns - min(self._arrivals)) * 1e-9
        own[1], own[2], own[3] = self._phase, self._missed, self._malformed
        return [
            (bus, messages.COMMAND, messages.encode_command(counter, [setpoints[joint] for joint in joints]))
            for bus, joints in enumerate(self._buses)
        ]

    # --- state ----------------------------------------------------------------------------------------------------

    _PLAIN = ("_imu_seen", "_phase", "_hold", "_since_ns", "_counter", "_missed", "_malformed")
    _LISTS = ("_states", "_counters", "_arrivals", "_fresh")
    _ARRAYS = ("telemetry", "_memory")
    _SHARED = ("gyro", "force")  # all else is computed anew

    def snapshot(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            **{name: getattr(self, name).copy() for name in (*self._LISTS, *self._ARRAYS)},
            **{name: getattr(self._space, name).copy() for name in self._SHARED},
            "hanging": self._hanging.snapshot(),
            "behaviour": self._behaviour.snapshot(),
            "frames": list(self._frames),
            "orientation": None if self._orientation is None else self._orientation.snapshot(),
            "contact": None if self._contact is None else self._contact.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        for name in (*self._LISTS, *self._ARRAYS):
            getattr(self, name)[:] = state[name]  # in place: the compiled functions are bound to the arrays
        for name in self._SHARED:
            getattr(self._space, name)[:] = state[name]
        self._hanging.restore(state["hanging"])
        self._behaviour.restore(state["behaviour"])
        self._frames[:] = state["frames"]
        if self._orientation is not None:
            self._orientation.restore(state["orientation"])
        if self._contact is not None:
            self._contact.restore(state["contact"])
