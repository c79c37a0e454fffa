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
from joint_firmware import protection, registers
from joint_firmware.communication import Communication
from joint_firmware.config import FirmwareConfig, Settings
from joint_firmware.drive import POWERED, DriveState, transition
from joint_firmware.laws import Offsets, drive_law
from joint_firmware.laws import signals as law
from joint_firmware.memory import LawMemory
from joint_firmware.object_dictionary import AbortCode, SdoAbort
from joint_firmware.objects import drive_dictionary
from joint_firmware.sdo import NEVER
from robots import pins
from robots.description import Robot

_STATE = struct.Struct("<" + messages.STATE_LAYOUT)  # filled with the integers that the law computed
_SLOT = struct.Struct("<" + messages.SLOT_LAYOUT)
_U16 = 0xFFFF
_ENABLED = DriveState.OPERATION_ENABLED  # a member of an Enum is slow to look up
_STOPPING = (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)
_NO_LIMIT = 1e9  # N m: the set-point's own limit where none comes with it
_WEIGHTS = (
    (Mode.TORQUE, law.U_TORQUE_MODE), (Mode.POSITION, law.U_POSITION_MODE), (Mode.OPEN_LOOP, law.U_OPEN_LOOP_MODE),
    (Mode.MOTOR_POSITION, law.U_MOTOR_POSITION_MODE), (Mode.JOINT_POSITION, law.U_JOINT_POSITION_MODE),
    (Mode.IMPEDANCE, law.U_IMPEDANCE_MODE),
)  # fmt: skip
_MODES = frozenset({Mode.NONE, Mode.DAMPING, *(mode for mode, _ in _WEIGHTS)})


def _identity(function: ca.Function) -> ca.Function:
    return function


class JointFirmware:
    """One drive: CiA 402 state machine, watchdog, control law, reports; a CANopen node. No I/O of its own.

    An output written in a tick takes effect at the next one, as with a PWM unit's shadow register.

    Two sources can command it: the command frame, and a master's SDOs. The frame has precedence: while one has come
    within the watchdog's time, and until the drive that it has enabled is at rest, SDOs that command are refused. Only
    what came by the frame is watched.
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
        config = config.of_joint(joint.name)
        rate = config.rate
        if rate % config.report_rate:
            slow = config.report_rate
            raise ValueError(f"rate ({rate:g} Hz) must be a multiple of report_rate ({slow:g} Hz)")
        self._ticks_per_report = round(rate / config.report_rate)
        self._quick_stop_ticks = round(config.quick_stop_time * rate)
        self._low = joint.limits[0] - protection.POSITION_MARGIN
        self._high = joint.limits[1] + protection.POSITION_MARGIN
        self._torque_fault = protection.TORQUE_FACTOR * config.torque_limit
        self._defaults = Settings(config, joint)

        self.law = drive_law(joint, config)
        self._started = self.law.states.index("started")
        self._law = memory = LawMemory(self.law, compile)
        self._evaluate, self._x, self._x_next = memory.evaluate, memory.x_array, memory.x_next_array
        self._counts, self.x, self.u, self.y = memory.counts, memory.x, memory.u, memory.y

        self.ticks = 0  # done; a timer that runs on through a reset, by which samples are numbered
        self._sent: list[Frame] = []  # what the tick under way has to send
        self.reset()
        self.dictionary = drive_dictionary(robot, joint, config)
        boot_ticks = round(config.boot_time * rate)
        self._communication = Communication(
            self.dictionary, self, rate, boot_ticks, self._ticks_per_report, config.heartbeat_period
        )
        registers.connect(self.dictionary, self)

    def reset(self) -> None:
        """Everything but the timer as after power-on."""
        self._law.clear()
        self._drive = DriveState.NOT_READY
        self.controlword = 0
        self.mode: int = Mode.NONE
        self.gain_set: int = GainSet.STANCE
        self._command_counter: int | None = None  # None: no command frame is in force
        self._command_tick = NEVER
        self._stop_tick = 0
        self.error = 0
        self._malformed = 0
        self.configure(**self._defaults._asdict())

    def configure(self, **changes: Any) -> None:
        """Change ``settings``, from this tick on."""
        previous = getattr(self, "settings", self._defaults)
        self.settings = settings = previous._replace(**changes)
        config = settings.config
        self._watchdog_ticks = max(round(config.watchdog * config.rate), 1)
        gains = {GainSet.STANCE: config.stance, GainSet.SWING: config.swing}
        self._gains = {index: (g.kp, g.ki, g.kd) for index, g in gains.items()}
        offsets = Offsets(settings.motor_offset, settings.spring_offset)
        self._law.p_array[:] = self.law.values(settings.joint, config, offsets)
        if (settings.joint.sensor, settings[2:4]) != (previous.joint.sensor, previous[2:4]):
            self.x[self._started] = 0.0  # a step of the calibration is no motion
        if self._command_counter is None:
            self.gain_set = settings.gain_set
        self._use_gains()

    def _use_gains(self) -> None:
        u = self.u
        u[law.U_KP], u[law.U_KI], u[law.U_KD] = self._gains.get(self.gain_set, self._gains[GainSet.STANCE])

    def attach(self, pins_in: np.ndarray, pins_out: np.ndarray) -> None:
        """Connect the pins: int32, ``robots.pins.N_INPUTS`` and ``N_OUTPUTS``."""
        self._in = memoryview(pins_in)  # type: ignore[arg-type]  # numpy's stubs have no buffer before 3.12
        self._out = memoryview(pins_out)  # type: ignore[arg-type]

    @property
    def state(self) -> DriveState:
        return self._drive

    @property
    def powered(self) -> bool:
        return self._drive in POWERED

    @property
    def counter(self) -> int:
        """Counter of the command frame in force, 0 when none is."""
        return self._command_counter or 0

    @property
    def malformed(self) -> int:
        """Frames that were ignored because their length did not fit."""
        return self._malformed + self._communication.malformed

    def pin(self, number: int) -> int:
        """An input pin of ``robots.pins``."""
        return self._in[number]

    # --- the ISR --------------------------------------------------------------------------------------------

    def tick(self, now_ns: int, frames: Sequence[Frame]) -> list[Frame]:
        """One interrupt: read pins, act on ``frames``, write pins. Returns the frames to send."""
        tick = self.ticks
        sent: list[Frame] = []
        for frame in frames:
            if frame.id == messages.COMMAND and not frame.extended:
                self._accept(frame.data, sent)
            else:
                self._sent = sent
                self._communication.receive(frame, tick, sent)
        inputs, counts, y = self._in, self._counts, self.y
        counts[0] = inputs[pins.MOTOR_ENCODER]
        counts[1] = inputs[pins.SPRING_ENCODER]
        counts[2] = inputs[pins.CURRENT_ADC]
        self._evaluate()
        self._x[:] = self._x_next
        silent = tick - self._command_tick >= self._watchdog_ticks
        if silent or self._drive is not _ENABLED:
            self._supervise(tick, sent)
        elif abs(y[law.Y_TORQUE_SI]) > self._torque_fault:
            self._fault(protection.OVER_TORQUE, sent)
        elif not self._low <= y[law.Y_POSITION_SI] <= self._high:
            self._fault(protection.POSITION_LIMIT, sent)
        powered = self._drive in POWERED
        self._out[pins.CURRENT_DEMAND] = int(y[law.Y_DEMAND]) if powered else 0
        self._out[pins.ENABLE] = 1 if powered else 0
        communication = self._communication
        if tick % self._ticks_per_report == 0 and communication.reporting:
            sent.append(Frame(self._state_id, self.report(tick)))
        if tick >= communication.due:
            communication.serve(tick, sent)
        self.ticks = tick + 1
        return sent

    def _accept(self, data: bytes, sent: list[Frame]) -> None:
        """Take over a command unless it is malformed or not newer than the one in force (a link may reorder).

        After a silence, a drive that is not enabled takes any counter: a restarted controller counts anew.
        """
        if not self._communication.listening:
            return
        if len(data) != messages.COMMAND_LENGTH:
            self._malformed += 1
            return
        counter = data[0] | data[1] << 8
        known = self._command_counter
        if known is not None and not messages.newer(counter, known):
            silent = self.ticks - self._command_tick >= self._watchdog_ticks
            if not silent or self._drive is _ENABLED:
                return  # a repeated frame must not feed the watchdog
        self._command_counter = counter
        self._command_tick = self.ticks
        slot = _SLOT.unpack_from(data, self._slot_offset)
        controlword, self.mode, self.gain_set, torque, position, velocity, limit, _ = slot
        u = self.u
        u[law.U_TORQUE] = torque * messages.NEWTON_METRE
        u[law.U_POSITION] = position * messages.RADIAN
        u[law.U_VELOCITY] = velocity * messages.RADIAN_PER_SECOND
        u[law.U_LIMIT] = limit * messages.TORQUE_LIMIT
        u[law.U_KP], u[law.U_KI], u[law.U_KD] = self._gains.get(self.gain_set, self._gains[GainSet.STANCE])
        if controlword != self.controlword or self._drive is not _ENABLED:
            self._switch(controlword, sent)
        self._apply_mode(self.mode)

    def _switch(self, controlword: int, sent: list[Frame]) -> None:
        """Act on a controlword, from whichever source."""
        entered = transition(self._drive, controlword, self.controlword)
        if entered == DriveState.QUICK_STOP_ACTIVE and self._drive != entered:
            self._stop_tick = self.ticks
        if self._drive == DriveState.FAULT and entered != DriveState.FAULT:
            self.error = protection.NO_ERROR
            self._communication.emergency(protection.NO_ERROR, sent)
        elif self.error and self._drive == DriveState.QUICK_STOP_ACTIVE and entered != self._drive:
            entered = DriveState.FAULT  # a stop for cause ends in fault, also when it is cut short
        self._drive = entered
        self.controlword = controlword

    # --- commands by SDO --------------------------------------------------------------------------------------

    def set_controlword(self, value: float) -> None:
        """Act on a controlword. Raises SdoAbort while the command frame is in force."""
        self._take_command()
        before = self._drive
        self._switch(int(value), self._sent)
        if self._drive is _ENABLED is not before:
            self._rest()
        self._apply_mode(self.mode)

    def set_mode(self, value: float) -> None:
        """Change the mode of operation. Raises SdoAbort for an unknown one, and while the command frame is in force."""
        if value not in _MODES:
            raise SdoAbort(AbortCode.VALUE)
        self._take_command()
        if value != self.mode:
            self.mode = int(value)
            self._rest()
        self._apply_mode(self.mode)

    def set_target(self, torque: float | None = None, position: float | None = None) -> None:
        """Change a set-point [N m, rad]. Raises SdoAbort while the command frame is in force."""
        self._take_command()
        if torque is not None:
            self.u[law.U_TORQUE] = torque
        if position is not None:
            self.u[law.U_POSITION] = position

    def _take_command(self) -> None:
        if self._command_counter is None:
            return
        silent = self.ticks - self._command_tick >= self._watchdog_ticks
        if not silent or self._drive is _ENABLED:  # enabled and silent: the watchdog comes first
            raise SdoAbort(AbortCode.DEVICE_STATE)
        self._command_counter = None
        self._command_tick = NEVER
        self.mode = Mode.NONE
        self._rest()

    def _rest(self) -> None:
        """Set-points that move nothing: no old one may act when a drive is enabled or its mode changes."""
        u = self.u
        u[law.U_TORQUE] = u[law.U_VELOCITY] = 0.0
        # the motor's, which the spring's torque does not move, unless the joint's own is fed back
        of_joint = self.mode in (Mode.JOINT_POSITION, Mode.IMPEDANCE)
        u[law.U_POSITION] = self.y[law.Y_POSITION_SI if of_joint else law.Y_RELAXED_SI]
        u[law.U_LIMIT] = _NO_LIMIT
        self.gain_set = self.settings.gain_set
        self._use_gains()

    # --- states -----------------------------------------------------------------------------------------------

    def _apply_mode(self, mode: int) -> None:
        """Weights of the law: the drive's state decides first what runs, the commanded mode second."""
        u = self.u
        enabled = self._drive is _ENABLED
        for number, weight in _WEIGHTS:
            u[weight] = float(enabled and mode == number)
        u[law.U_ENABLED] = float(enabled)
        stopping = self._drive in _STOPPING
        u[law.U_DAMPING_MODE] = float(stopping or (enabled and mode == Mode.DAMPING))

    def _supervise(self, tick: int, sent: list[Frame]) -> None:
        """Everything but normal operation: watchdog, the end of a quick stop."""
        if self._drive is _ENABLED:
            self.stop(sent)
        elif self._drive == DriveState.QUICK_STOP_ACTIVE and tick - self._stop_tick >= self._quick_stop_ticks:
            # a commanded stop ends switched off; a stop for cause ends in fault
            self._drive = DriveState.FAULT if self.error else DriveState.SWITCH_ON_DISABLED
            self._apply_mode(Mode.NONE)

    def stop(self, sent: list[Frame]) -> None:
        """The master is lost, or has stopped the node: an enabled drive makes a quick stop, for cause."""
        if self._drive is _ENABLED:
            self.error = protection.WATCHDOG
            self._communication.emergency(protection.WATCHDOG, sent)
            self._drive = DriveState.QUICK_STOP_ACTIVE
            self._stop_tick = self.ticks
            self._apply_mode(Mode.DAMPING)

    def _fault(self, code: int, sent: list[Frame]) -> None:
        """Power off at once and say why."""
        self.error = code
        self._drive = DriveState.FAULT
        self._apply_mode(Mode.NONE)
        self._communication.emergency(code, sent)

    def booted(self) -> None:
        """The node is on the bus: the drive may be switched on."""
        if self._drive == DriveState.NOT_READY:
            self._drive = DriveState.SWITCH_ON_DISABLED

    def report(self, tick: int) -> bytes:
        """The state of the last sample, as TPDO1 carries it."""
        y = self.y
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
            self.error & 0xFF,
            min(max(temperature, 0), 255),
        )

    # --- state ----------------------------------------------------------------------------------------------

    _PLAIN = (
        "ticks", "_drive", "controlword", "mode", "gain_set", "_command_counter", "_command_tick", "_stop_tick",
        "error", "_malformed",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Everything that a tick depends on beside pins and frames."""
        plain = {name: getattr(self, name) for name in self._PLAIN}
        return {
            **plain,
            "settings": tuple(self.settings),
            "communication": self._communication.snapshot(),
            **self._law.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self.configure(**Settings(*state["settings"])._asdict())
        self._communication.restore(state["communication"])
        self._law.restore(state)
