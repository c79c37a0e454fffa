"""The firmware node of one joint: called at its ISR rate with its pins and the frames that arrived."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from bus import messages
from bus.frames import Frame
from bus.messages import GainSet, Mode
from joint_firmware import law, protection
from joint_firmware.config import FirmwareConfig
from joint_firmware.drive import POWERED, DriveState, transition
from robots import pins
from robots.description import Robot

_NMT_BOOT, _NMT_OPERATIONAL = 0x00, 0x05
_STATE = struct.Struct("<" + messages.STATE_LAYOUT)  # filled with the integers that the law computed
_SLOT = struct.Struct("<" + messages.SLOT_LAYOUT)
_U16 = 0xFFFF


def _identity(function: ca.Function) -> ca.Function:
    return function


def _view(array: np.ndarray) -> memoryview[float]:
    """``array``'s memory, whose items read and write several times faster than the array's."""
    return memoryview(array)  # type: ignore[arg-type, return-value]  # the stubs know bytes only


class JointFirmware:
    """One drive: CiA 402 state machine, watchdog, control law, reports. No I/O of its own.

    An output written in a tick takes effect at the next one, as with a PWM unit's shadow register.
    """

    def __init__(
        self,
        robot: Robot,
        joint_index: int,
        config: FirmwareConfig,
        compile: Callable[[ca.Function], ca.Function] = _identity,
    ) -> None:
        joint = robot.joints[joint_index]
        bus = next(bus for bus in robot.buses if joint.name in bus.joints)
        self.name, self.node_id = joint.name, joint.node_id
        self._slot_offset = 4 + _SLOT.size * bus.joints.index(joint.name)
        self._state_id = messages.STATE + joint.node_id
        self._heartbeat_id = messages.HEARTBEAT + joint.node_id
        self._emergency_id = messages.EMERGENCY + joint.node_id
        rate = config.rate
        if rate % config.report_rate:
            slow = config.report_rate
            raise ValueError(f"rate ({rate:g} Hz) must be a multiple of report_rate ({slow:g} Hz)")
        self._ticks_per_report = round(rate / config.report_rate)
        self._boot_ticks = round(config.boot_time * rate)
        self._watchdog_ticks = max(round(config.watchdog * rate), 1)
        self._quick_stop_ticks = round(config.quick_stop_time * rate)
        # heartbeats go out on ticks without a report, when the bus is idle, one drive after the other
        period = max(round(config.heartbeat_period * rate), self._ticks_per_report)
        self._heartbeat_ticks = period + (-period) % self._ticks_per_report
        slot = 1 if self._ticks_per_report > 1 else 0
        self._heartbeat_phase = (slot + self._ticks_per_report * joint.node_id) % self._heartbeat_ticks
        gains = {GainSet.STANCE: config.stance, GainSet.SWING: config.swing}
        self._gains = {index: (g.kp, g.ki, g.kd) for index, g in gains.items()}
        self._low = joint.limits[0] - protection.POSITION_MARGIN
        self._high = joint.limits[1] + protection.POSITION_MARGIN
        self._torque_fault = protection.TORQUE_FACTOR * config.torque_limit

        self._counts = np.zeros(3)
        self._x = np.zeros(law.STATE_SIZE)
        self._u = np.zeros(law.INPUT_SIZE)
        self._p = law.parameters(joint, config)
        self._x_next = np.zeros(law.STATE_SIZE)
        self._y = np.zeros(law.OUTPUT_SIZE)
        self._function = compile(law.control_law())
        self._bind()

        self._tick = 0
        self._drive = DriveState.NOT_READY
        self._controlword = 0
        self._command_counter: int | None = None
        self._command_tick = 0
        self._stop_tick = 0
        self._error = 0
        self._malformed = 0

    def _bind(self) -> None:
        """Hand the law its memory once: a call then neither allocates nor converts."""
        self._buffer, self._evaluate = self._function.buffer()
        arguments = (self._counts, self._x, self._u, self._p)
        for index, array in enumerate(arguments):
            # a memoryview brings its size along; the stubs ask for it
            self._buffer.set_arg(index, _view(array))  # type: ignore[call-arg, arg-type]
        for index, array in enumerate((self._x_next, self._y)):
            self._buffer.set_res(index, _view(array))  # type: ignore[call-arg, arg-type]
        self._counts_view = _view(self._counts)
        self._u_view = _view(self._u)
        self._y_view = _view(self._y)

    def attach(self, pins_in: np.ndarray, pins_out: np.ndarray) -> None:
        """Connect the pins: int32, ``robots.pins.N_INPUTS`` and ``N_OUTPUTS``."""
        self._in = memoryview(pins_in)  # type: ignore[arg-type]  # numpy's stubs have no buffer before 3.12
        self._out = memoryview(pins_out)  # type: ignore[arg-type]

    @property
    def state(self) -> DriveState:
        return self._drive

    @property
    def malformed(self) -> int:
        """Frames that were ignored because their length did not fit."""
        return self._malformed

    # --- the ISR --------------------------------------------------------------------------------------------

    def tick(self, now_ns: int, frames: Sequence[Frame]) -> list[Frame]:
        """One interrupt: read pins, act on ``frames``, write pins. Returns the frames to send."""
        tick = self._tick
        sent: list[Frame] = []
        for frame in frames:
            if frame.id == messages.COMMAND and not frame.extended:
                self._accept(frame.data, sent)
        inputs, counts, y = self._in, self._counts_view, self._y_view
        counts[0] = inputs[pins.MOTOR_ENCODER]
        counts[1] = inputs[pins.SPRING_ENCODER]
        counts[2] = inputs[pins.CURRENT_ADC]
        self._evaluate()
        self._x[:] = self._x_next
        silent = tick - self._command_tick >= self._watchdog_ticks
        if silent or self._drive != DriveState.OPERATION_ENABLED:
            self._supervise(tick, sent)
        elif abs(y[law.Y_TORQUE_SI]) > self._torque_fault:
            self._fault(protection.OVER_TORQUE, sent)
        elif not self._low <= y[law.Y_POSITION_SI] <= self._high:
            self._fault(protection.POSITION_LIMIT, sent)
        powered = self._drive in POWERED
        self._out[pins.CURRENT_DEMAND] = int(y[law.Y_DEMAND]) if powered else 0
        self._out[pins.ENABLE] = 1 if powered else 0
        if tick % self._ticks_per_report == 0:
            sent.append(Frame(self._state_id, self._report(tick)))
        if tick % self._heartbeat_ticks == self._heartbeat_phase:
            booted = self._drive != DriveState.NOT_READY
            sent.append(Frame(self._heartbeat_id, bytes([_NMT_OPERATIONAL if booted else _NMT_BOOT])))
        self._tick = tick + 1
        return sent

    def _accept(self, data: bytes, sent: list[Frame]) -> None:
        """Take over a command unless it is malformed or not newer than the one in force (a link may reorder).

        After a silence, a drive that is not enabled takes any counter: a restarted controller counts anew.
        """
        if len(data) != messages.COMMAND_LENGTH:
            self._malformed += 1
            return
        counter = data[0] | data[1] << 8
        known = self._command_counter
        if known is not None and not messages.newer(counter, known):
            silent = self._tick - self._command_tick >= self._watchdog_ticks
            if not silent or self._drive == DriveState.OPERATION_ENABLED:
                return  # a repeated frame must not feed the watchdog
        self._command_counter = counter
        self._command_tick = self._tick
        slot = _SLOT.unpack_from(data, self._slot_offset)
        controlword, mode, gain_set, torque, position, velocity, limit, _ = slot
        u = self._u_view
        u[law.U_TORQUE] = torque * messages.NEWTON_METRE
        u[law.U_POSITION] = position * messages.RADIAN
        u[law.U_VELOCITY] = velocity * messages.RADIAN_PER_SECOND
        u[law.U_LIMIT] = limit * messages.TORQUE_LIMIT
        u[law.U_KP], u[law.U_KI], u[law.U_KD] = self._gains.get(gain_set, self._gains[GainSet.STANCE])
        if controlword != self._controlword or self._drive != DriveState.OPERATION_ENABLED:
            entered = transition(self._drive, controlword, self._controlword)
            if entered == DriveState.QUICK_STOP_ACTIVE and self._drive != entered:
                self._stop_tick = self._tick
            if self._drive == DriveState.FAULT and entered != DriveState.FAULT:
                self._error = 0
                self._send_emergency(protection.NO_ERROR, 0, sent)
            elif self._error and self._drive == DriveState.QUICK_STOP_ACTIVE and entered != self._drive:
                entered = DriveState.FAULT  # a stop for cause ends in fault, also when it is cut short
            self._drive = entered
            self._controlword = controlword
        self._set_mode(mode)

    def _set_mode(self, mode: int) -> None:
        """Weights of the law: the drive's state decides first what runs, the commanded mode second."""
        u = self._u_view
        enabled = self._drive == DriveState.OPERATION_ENABLED
        u[law.U_TORQUE_MODE] = float(enabled and mode == Mode.TORQUE)
        u[law.U_POSITION_MODE] = float(enabled and mode == Mode.POSITION)
        stopping = self._drive in (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)
        u[law.U_DAMPING_MODE] = float(stopping or (enabled and mode == Mode.DAMPING))

    def _supervise(self, tick: int, sent: list[Frame]) -> None:
        """Everything but normal operation: boot, watchdog, the end of a quick stop."""
        if self._drive == DriveState.NOT_READY:
            if tick >= self._boot_ticks:
                self._drive = DriveState.SWITCH_ON_DISABLED
        elif self._drive == DriveState.OPERATION_ENABLED:
            self._error = protection.WATCHDOG
            self._send_emergency(protection.WATCHDOG, protection.COMMUNICATION_ERROR, sent)
            self._drive = DriveState.QUICK_STOP_ACTIVE
            self._stop_tick = tick
            self._set_mode(Mode.DAMPING)
        elif self._drive == DriveState.QUICK_STOP_ACTIVE and tick - self._stop_tick >= self._quick_stop_ticks:
            # a commanded stop ends switched off; a stop for cause ends in fault
            self._drive = DriveState.FAULT if self._error else DriveState.SWITCH_ON_DISABLED
            self._set_mode(Mode.NONE)

    def _fault(self, code: int, sent: list[Frame]) -> None:
        """Power off at once and say why."""
        self._error = code
        self._drive = DriveState.FAULT
        self._set_mode(Mode.NONE)
        self._send_emergency(code, protection.GENERIC_ERROR, sent)

    def _send_emergency(self, code: int, register: int, sent: list[Frame]) -> None:
        sent.append(Frame(self._emergency_id, messages.encode_emergency(code, register)))

    def _report(self, tick: int) -> bytes:
        y = self._y_view
        statusword = int(self._drive)
        if self._in[pins.SWITCHES] & pins.FOOT_SWITCH:
            statusword |= messages.Statusword.FOOT_CONTACT
        if y[law.Y_LIMITED]:
            statusword |= messages.Statusword.LIMITED
        temperature = int(self._in[pins.TEMPERATURE_ADC] * pins.KELVIN_PER_COUNT)
        return _STATE.pack(
            tick // self._ticks_per_report & _U16,
            statusword,
            int(y[law.Y_POSITION]),
            int(y[law.Y_VELOCITY]),
            int(y[law.Y_TORQUE]),
            int(y[law.Y_CURRENT]),
            int(y[law.Y_MOTOR_VELOCITY]),
            self._command_counter or 0,
            self._error & 0xFF,
            min(max(temperature, 0), 255),
        )

    # --- state ----------------------------------------------------------------------------------------------

    _PLAIN = (
        "_tick", "_drive", "_controlword", "_command_counter", "_command_tick", "_stop_tick", "_error",
        "_malformed",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Everything that a tick depends on beside pins and frames."""
        plain = {name: getattr(self, name) for name in self._PLAIN}
        return {**plain, "x": self._x.copy(), "u": self._u.copy(), "y": self._y.copy()}

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self._x[:], self._u[:], self._y[:] = state["x"], state["u"], state["y"]
