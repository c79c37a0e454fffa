"""The firmware node of one joint: called at its ISR rate with its pins and the frames that arrived."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from bus import messages
from bus.drive_faults import EMERGENCIES, DriveFault
from bus.frames import Frame
from bus.messages import GainSet, Mode, newer
from joint_firmware import registers
from joint_firmware.communication import Communication
from joint_firmware.config import FirmwareConfig, JointConfig, Settings
from joint_firmware.drive import POWERED, DriveState, transition
from joint_firmware.laws import Offsets, drive_law
from joint_firmware.laws import signals as law
from joint_firmware.laws.load_cell import has_load_cell
from joint_firmware.memory import LawMemory
from joint_firmware.object_dictionary import AbortCode, SdoAbort
from joint_firmware.objects import drive_dictionary
from joint_firmware.protection import BRAKING_MASK, REACTIONS, Reaction, first
from joint_firmware.sdo import NEVER
from joint_firmware.setpoints import MODES, Setpoints, weights
from joint_firmware.synchronisation import Synchronisation, recalibrated
from robots import pins
from robots.description import Robot

_STATE = struct.Struct("<" + messages.STATE_LAYOUT)  # filled with the integers that the law computed
_U16 = 0xFFFF
_SENSELESS = 3  # command frames in a row that are not acted upon; then the drive does not wait for the watchdog
_ENABLED = DriveState.OPERATION_ENABLED  # a member of an Enum is slow to look up
# so is a constant of another module
_Y_DEMAND, _Y_TRIPS = law.Y_DEMAND, law.Y_TRIPS
_COMMAND, _COMMAND_LENGTH = messages.COMMAND, messages.COMMAND_LENGTH
_DEMAND_PIN, _ENABLE_PIN = pins.CURRENT_DEMAND, pins.ENABLE
_SWITCHES, _FOOT_SWITCH = pins.SWITCHES, pins.FOOT_SWITCH
_TEMPERATURE_ADC, _KELVIN_PER_COUNT = pins.TEMPERATURE_ADC, pins.KELVIN_PER_COUNT
_FOOT_CONTACT, _LIMITED = messages.Statusword.FOOT_CONTACT, messages.Statusword.LIMITED
_STOPPING = (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)


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
        self._state_id = messages.STATE + joint.node_id
        joint_offset = config.joints.get(joint.name, JointConfig()).encoder_offset
        config = config.of_joint(joint.name)
        rate = config.rate
        if rate % config.report_rate:
            slow = config.report_rate
            raise ValueError(f"rate ({rate:g} Hz) must be a multiple of report_rate ({slow:g} Hz)")
        self._ticks_per_report = round(rate / config.report_rate)
        self._quick_stop_ticks = round(config.quick_stop_time * rate)
        self._boot_ticks = round(config.boot_time * rate)
        self._defaults = Settings(config, joint, joint_offset=joint_offset)

        self.law = drive_law(joint, config)
        self._started = self.law.states.index("started")
        self._law = memory = LawMemory(self.law, compile)
        self._evaluate, self._counts, self._x_next = memory.evaluate, memory.counts_array, memory.x_next
        self.x, self.u, self.y = memory.x, memory.u, memory.y
        self._reported = memory.y[law.Y_POSITION : law.Y_LIMITED + 1]
        self._setpoints = Setpoints(memory.u_array, bus.joints.index(joint.name))

        self.ticks = 0  # done; a timer that runs on through a reset, by which samples are numbered
        self._sent: list[Frame] = []  # what the tick under way has to send
        self.reset()
        self.dictionary = drive_dictionary(robot, joint, config)
        self._communication = Communication(
            self.dictionary, self, rate, self._boot_ticks, self._ticks_per_report, config.heartbeat_period
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
        self.fault = DriveFault.NONE
        self._malformed = 0
        self._senseless = 0  # command frames in a row that were not acted upon
        self.configure(**self._defaults._asdict())
        self._synchronisation = Synchronisation(self._boot_ticks)
        self.referenced = has_load_cell(self.settings.joint)  # else no position means anything yet

    def configure(self, **changes: Any) -> None:
        """Change ``settings``, from this tick on."""
        previous = getattr(self, "settings", self._defaults)
        self.settings = settings = previous._replace(**changes)
        config = settings.config
        self._watchdog_ticks = max(round(config.watchdog * config.rate), 1)
        offsets = Offsets(settings.motor_offset, settings.spring_offset, settings.joint_offset)
        self._law.p_array[:] = values = self.law.values(settings.joint, config, offsets)
        self._setpoints.configure(config, dict(zip(self.law.parameters, values.tolist(), strict=True)))
        if (settings.joint.sensor, settings[2:5]) != (previous.joint.sensor, previous[2:5]):
            self.x[self._started] = 0.0  # a step of the calibration is no motion
        if self._command_counter is None:
            self.gain_set = settings.gain_set
        self._setpoints.use_gains(self.gain_set)

    def attach(self, pins_in: np.ndarray, pins_out: np.ndarray) -> None:
        """Connect the pins: int32, ``robots.pins.N_INPUTS`` and ``N_OUTPUTS``."""
        self._pins = pins_in
        self._in = memoryview(pins_in)  # type: ignore[arg-type]  # numpy's stubs have no buffer before 3.12
        self._out = memoryview(pins_out)  # type: ignore[arg-type]

    @property
    def state(self) -> DriveState:
        return self._drive

    @property
    def powered(self) -> bool:
        return self._drive in POWERED

    @property
    def error(self) -> int:
        """Error code of the fault in force (CiA 402, 0x603F)."""
        return EMERGENCIES[self.fault].code

    def levels(self) -> list[float]:
        """What share of its limit each of the drive's faults uses, from number 1 on; 0 where nothing measures it."""
        memory = self._law
        levels = self.law.levels(self._counts, memory.x_array, memory.u_array, memory.p_array)
        return [float(level) for level in levels.full().ravel()]

    def keep_peaks(self, compile: Callable[[ca.Function], ca.Function] = _identity) -> np.ndarray:
        """Keep the largest of ``levels`` of every tick from now on. Returns them, in an array that goes on changing."""
        levels = np.zeros(self.law.levels.numel_out(0))
        peaks = np.zeros_like(levels)
        level, law_alone = self._law.bind(compile(self.law.levels), levels), self._evaluate

        def evaluate() -> None:
            level()
            np.maximum(peaks, levels, out=peaks)
            law_alone()

        self._evaluate = evaluate
        return peaks

    @property
    def counter(self) -> int:
        """Counter of the command frame in force, 0 when none is."""
        return self._command_counter or 0

    @property
    def malformed(self) -> int:
        """Frames that were ignored because their length did not fit, or their set-point made no sense."""
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
            can_id, data, _, _, extended, _, _ = frame
            if can_id == _COMMAND and not extended:
                self._accept(data, sent)
            else:
                self._sent = sent
                self._communication.receive(frame, tick, sent)
        if self._drive is not _ENABLED or tick - self._command_tick >= self._watchdog_ticks:
            self._supervise(tick, sent)
        y, out = self.y, self._out
        self._counts[:] = self._pins
        if not self.referenced:
            self._synchronise()
        self._evaluate()
        self.x[:] = self._x_next
        if y[_Y_TRIPS]:
            self._protect(int(y[_Y_TRIPS]), sent)
        if self._drive in POWERED:
            out[_DEMAND_PIN] = int(y[_Y_DEMAND])
            out[_ENABLE_PIN] = 1
        else:
            out[_DEMAND_PIN] = out[_ENABLE_PIN] = 0
        communication = self._communication
        if tick % self._ticks_per_report == 0 and communication.reporting:
            sent.append(Frame(self._state_id, self.report(tick)))
        if tick >= communication.due:
            communication.serve(tick, sent)
        self.ticks = tick + 1
        return sent

    def _synchronise(self) -> None:
        """Find the motor's zero; it is found before the node boots, and so before there is power or protection."""
        self._synchronisation.add(self._in, self.settings)
        if self._synchronisation.done:
            self.referenced = True
            self.configure(motor_offset=self._synchronisation.motor_offset)
            self._law.restart()  # what it has sensed so far is of no position

    def recalibrated(self, joint_offset: float) -> dict[str, float]:
        """What of the settings changes where the absolute encoder reads ``joint_offset`` [rad] at 0 rad."""
        return recalibrated(self.settings, joint_offset, self.y[law.Y_POSITION_SI])

    def _accept(self, data: bytes, sent: list[Frame]) -> None:
        """Take over a command unless it is malformed or not newer than the one in force (a link may reorder).

        After a silence, a drive that is not enabled takes any counter: a restarted controller counts anew.
        """
        if not self._communication.listening:
            return
        if len(data) != _COMMAND_LENGTH:
            self._malformed += 1
            return
        counter = data[0] | data[1] << 8
        known = self._command_counter
        if known is not None and not newer(counter, known):
            silent = self.ticks - self._command_tick >= self._watchdog_ticks
            if not silent or self._drive is _ENABLED:
                return  # a repeated frame must not feed the watchdog
        setpoints = self._setpoints
        order = setpoints.read(data)
        if not setpoints.sensible(order):
            self._disregard(sent)
            return
        self._senseless = 0
        self._command_counter = counter
        self._command_tick = self.ticks
        controlword, self.mode, self.gain_set = order[:3]
        if controlword != self.controlword or self._drive is not _ENABLED:
            self._switch(controlword, sent)
        enabled = self._drive is _ENABLED
        setpoints.follow(order, enabled, not enabled and self._drive in _STOPPING)

    def _disregard(self, sent: list[Frame]) -> None:
        """A set-point makes no sense: neither acted upon nor taken for a sign of life, but not borne for long."""
        self._malformed += 1
        self._senseless += 1
        if self._senseless >= _SENSELESS:
            self._protect(1 << DriveFault.COMMAND, sent)

    def _switch(self, controlword: int, sent: list[Frame]) -> None:
        """Act on a controlword, from whichever source."""
        entered = transition(self._drive, controlword, self.controlword)
        if entered == DriveState.QUICK_STOP_ACTIVE and self._drive != entered:
            self._stop_tick = self.ticks
        if self._drive == DriveState.FAULT and entered != DriveState.FAULT:
            if self.y[_Y_TRIPS]:
                entered = DriveState.FAULT  # a cause is still there
            else:
                self._note(DriveFault.NONE, sent)
        elif self.fault and self._drive == DriveState.QUICK_STOP_ACTIVE and entered != self._drive:
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
        if value not in MODES:
            raise SdoAbort(AbortCode.VALUE)
        self._take_command()
        if value != self.mode:
            self.mode = int(value)
            self._rest()
        self._apply_mode(self.mode)

    def set_target(self, torque: float | None = None, position: float | None = None) -> None:
        """Change a set-point [N m, rad]. Raises SdoAbort while the command frame is in force."""
        self._take_command()
        self._setpoints.target(torque, position)

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
        self.gain_set = self.settings.gain_set
        # the motor's, which the spring's torque does not move, unless the joint's own is fed back
        of_joint = self.mode in (Mode.JOINT_POSITION, Mode.IMPEDANCE)
        self._setpoints.rest(self.y[law.Y_POSITION_SI if of_joint else law.Y_RELAXED_SI], self.gain_set)

    # --- states -----------------------------------------------------------------------------------------------

    def _apply_mode(self, mode: int) -> None:
        self._setpoints.weigh(weights(mode, self._drive is _ENABLED, self._drive in _STOPPING))

    def _supervise(self, tick: int, sent: list[Frame]) -> None:
        """Everything but normal operation: watchdog, the end of a stop."""
        drive = self._drive
        if drive is _ENABLED:
            self.stop(sent)
        elif drive in _STOPPING and tick - self._stop_tick >= self._quick_stop_ticks:
            # a commanded stop ends switched off; a stop for cause ends in fault
            self._drive = DriveState.FAULT if self.fault else DriveState.SWITCH_ON_DISABLED
            self._apply_mode(Mode.NONE)

    def stop(self, sent: list[Frame]) -> None:
        """The master is lost, or has stopped the node: an enabled drive makes a quick stop, for cause."""
        if self._drive is _ENABLED:
            self._brake(DriveFault.WATCHDOG, DriveState.QUICK_STOP_ACTIVE, sent)

    def _protect(self, trips: int, sent: list[Frame]) -> None:
        """React to what has tripped, if there is power; while braking, only to what braking itself relies on."""
        braking = self._drive in _STOPPING
        if braking:
            trips &= BRAKING_MASK
        if not trips or self._drive not in POWERED:
            return
        fault = first(trips)
        if braking or REACTIONS[fault] is Reaction.POWER_OFF:
            self._power_off(fault, sent)
        else:
            self._brake(fault, DriveState.FAULT_REACTION_ACTIVE, sent)

    def _brake(self, fault: DriveFault, state: DriveState, sent: list[Frame]) -> None:
        self._note(fault, sent)
        self._drive = state
        self._stop_tick = self.ticks
        self._apply_mode(Mode.DAMPING)

    def _power_off(self, fault: DriveFault, sent: list[Frame]) -> None:
        self._note(fault, sent)
        self._drive = DriveState.FAULT
        self._apply_mode(Mode.NONE)

    def _note(self, fault: DriveFault, sent: list[Frame]) -> None:
        """Take ``fault`` for the one in force (NONE: it is gone) and tell it."""
        self.fault = fault
        self._communication.emergency(fault, sent)

    def booted(self) -> None:
        """The node is on the bus: the drive may be switched on."""
        if self._drive == DriveState.NOT_READY:
            self._drive = DriveState.SWITCH_ON_DISABLED

    def report(self, tick: int) -> bytes:
        """The state of the last sample, as TPDO1 carries it."""
        position, velocity, torque, current, motor_velocity, _, limited = self._reported
        statusword = int(self._drive)
        if self._in[_SWITCHES] & _FOOT_SWITCH:
            statusword |= _FOOT_CONTACT
        if limited:
            statusword |= _LIMITED
        temperature = int(self._in[_TEMPERATURE_ADC] * _KELVIN_PER_COUNT)
        return _STATE.pack(
            tick // self._ticks_per_report & _U16,
            statusword,
            int(position),
            int(velocity),
            int(torque),
            int(current),
            int(motor_velocity),
            self._command_counter or 0,
            self.fault,
            min(max(temperature, 0), 255),
        )

    # --- state ----------------------------------------------------------------------------------------------

    _PLAIN = (
        "ticks", "_drive", "controlword", "mode", "gain_set", "_command_counter", "_command_tick", "_stop_tick",
        "fault", "_malformed", "_senseless", "referenced",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Everything that a tick depends on beside pins and frames."""
        plain = {name: getattr(self, name) for name in self._PLAIN}
        return {
            **plain,
            "settings": tuple(self.settings),
            "synchronisation": self._synchronisation.snapshot(),
            "communication": self._communication.snapshot(),
            **self._law.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self.configure(**Settings(*state["settings"])._asdict())
        self._synchronisation.restore(state["synchronisation"])
        self._communication.restore(state["communication"])
        self._law.restore(state)
