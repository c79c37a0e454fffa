"""The other end of the bus: a master that enables one drive and then commands it at its servo rate."""

from __future__ import annotations

from collections.abc import Callable

from bus import messages
from bus.frames import Frame
from bus.messages import Controlword, Mode, Setpoint, State, Statusword
from robots.description import Robot

_ANSWERS = {  # CiA 402: the way to OPERATION ENABLED
    Statusword.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    Statusword.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    Statusword.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    Statusword.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
}

# What is asked for: from the servo tick's number since the drive was enabled, and its last state.
Command = Callable[[int, State], Setpoint]


class Master:
    """Answers each servo tick with a command frame. A drive that drops out of operation is not brought back.

    ``command`` may close a loop of its own around the drive's reports. ``enabled_tick`` is the first servo tick that it
    was asked for.
    """

    def __init__(self, robot: Robot, joint_index: int, command: Command) -> None:
        joint = robot.joints[joint_index]
        bus = next(bus for bus in robot.buses if joint.name in bus.joints)
        self._slot, self._state_id = bus.joints.index(joint.name), messages.STATE + joint.node_id
        self._command = command
        self._state: State | None = None
        self._counter = 0
        self._tick = 0
        self.enabled_tick: int | None = None
        self.failure: str | None = None  # why the drive is no longer in operation

    def receive(self, frame: Frame) -> None:
        """Take note of a frame from the bus."""
        if frame.id == self._state_id and not frame.extended:
            self._state = messages.decode_state(frame.data)

    def tick(self) -> Frame | None:
        """One servo tick. Returns the command frame; None as long as the drive has not reported."""
        state = self._state
        self._tick += 1
        if state is None:
            return None
        status = state.statusword & Statusword.MASK
        word = _ANSWERS.get(status, Controlword.DISABLE_VOLTAGE)
        setpoint = Setpoint(mode=Mode.TORQUE)
        if status == Statusword.OPERATION_ENABLED and self.failure is None:
            if self.enabled_tick is None:
                self.enabled_tick = self._tick
            setpoint = self._command(self._tick - self.enabled_tick, state)
        elif self.enabled_tick is not None:
            self.failure = self.failure or f"the drive left operation with error {state.error:#04x}"
            word = Controlword.DISABLE_VOLTAGE
        self._counter = self._counter + 1 & 0xFFFF
        slots = [Setpoint()] * messages.SLOTS
        slots[self._slot] = setpoint._replace(controlword=word, state_counter=state.counter)
        return Frame(messages.COMMAND, messages.encode_command(self._counter, slots))
