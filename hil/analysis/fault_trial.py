"""Trials of a drive's protection: from one and the same moment of a run, one fault after the other is brought about."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from bus import messages
from bus.drive_faults import EMERGENCIES, DriveFault
from bus.frames import ErrorFrame, Frame
from hil.analysis.fault_cases import FaultCase
from hil.errors import UserError
from hil.run import Assembly, Request, assemble
from hil.scenario import load
from hil.schema import nearest
from joint_firmware.drive import DriveState
from joint_firmware.laws import signals
from joint_firmware.protection import REACTIONS, Reaction
from robots import description, pins

SCENARIO = "split-terrain"
SETTINGS = ("controller.path.start=1.7s", "controller.path.period=2s")  # it sways: sensors have something to show
START = 2.9  # s: the left knee carries 10 A
JOINT = "left_knee"
_TICK_NS = 333_334


class Listener:
    """In the place of attached tools: notes the emergencies of all drives as (time, node, code, register)."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, int, int, int]] = []

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        node = frame.id - messages.EMERGENCY
        if 0 < node < 128 and len(frame.data) == messages.EMERGENCY_LENGTH:
            code, register, _ = messages.decode_emergency(frame.data)
            self.heard.append((time_ns, node, code, register))

    def broadcast_error(self, bus: int, time_ns: int, sender: int, error: ErrorFrame) -> None:
        pass

    def set_state(self, bus: int, tec: int, rec: int, state: int) -> None:
        pass

    def poll(self) -> list[tuple[int, Frame]]:
        return []

    def refused(self, bus: int, frame: Frame) -> None:
        pass


@dataclass(frozen=True)
class Trial:
    """What a drive did. ``safe_after``: s, to the first interrupt whose output was safe; None: none was."""

    case: FaultCase
    safe_after: float | None
    state: DriveState  # in that interrupt
    fault: int
    enabled: int
    demand: int  # counts
    braking: int  # counts that braking by the motor's velocity would demand
    emergencies: tuple[tuple[int, int], ...]  # of the drive: code, register

    def what_is_wrong(self) -> str:
        """What is not as it should be; empty when all is."""
        case, emergency = self.case, EMERGENCIES[self.case.fault]
        if self.safe_after is None or self.safe_after > case.within:
            return f"not within {1e3 * case.within:g} ms"
        if self.fault != case.fault:
            return f"taken for {DriveFault(self.fault).name.lower()}"
        if REACTIONS[case.fault] is Reaction.POWER_OFF:
            if self.state is not DriveState.FAULT:
                return f"in state {self.state.name}"
            if self.enabled or self.demand:
                return f"a demand of {self.demand} counts"
        else:
            if self.state not in (DriveState.FAULT_REACTION_ACTIVE, DriveState.QUICK_STOP_ACTIVE):
                return f"in state {self.state.name}"
            if not self.enabled or abs(self.demand - self.braking) > 1:
                return f"a demand of {self.demand} counts instead of {self.braking}"
        silent = case.key == "node.cut"  # and cannot say so
        if self.emergencies != (() if silent else ((emergency.code, emergency.registers),)):
            return f"told as {self.emergencies}"
        return ""

    @property
    def good(self) -> bool:
        return not self.what_is_wrong()


class TrialBench:
    """A run that is set back to ``START`` before each trial."""

    def __init__(self, assembly: Assembly, joint: str = JOINT) -> None:
        self._system: Any = assembly.system
        self._system.monitor = None  # it would end the run at the fault
        self.robot = description.load(self._system.scenario.robot)
        if joint not in self.robot.joint_names:
            raise UserError(f"no joint {joint!r}{nearest(joint, self.robot.joint_names)}")
        self._joint = self.robot.joint_names.index(joint)
        self._bus = next(bus.name for bus in self.robot.buses if joint in bus.joints)
        self.drive = self._system.joints.nodes[self._joint]
        self._pins_out = assembly.world.pins_out[self._joint]
        self.listener = self._system.tap = Listener()
        self._system.run_until(round(START * 1e9))
        self._start = self._system.snapshot()

    def rewind(self) -> None:
        """Back to the start."""
        self._system.restore(self._start)
        self.listener.heard.clear()

    def bring_about(self, case: FaultCase) -> None:
        """From now on."""
        if case.key:
            self._system.inject(case.injection(self._bus, self.drive.name), case.value)
        self.lower(case)

    def lower(self, case: FaultCase) -> None:
        config = self.drive.settings.config
        limits = dict(case.limits)
        joint = self.drive.settings.joint
        if "soft_stop_below" in limits:
            high = self.drive.y[signals.Y_POSITION_SI] - limits.pop("soft_stop_below")
            joint = joint.model_copy(update={"limits": (min(joint.limits[0], high), high)})
        protection = config.protection.model_copy(update=limits)
        self.drive.configure(config=config.model_copy(update={"protection": protection}), joint=joint)

    def end(self, case: FaultCase, healthy: Any) -> None:
        """Take the cause away: the key's value ``healthy``, and the limits as configured."""
        if case.key:
            self._system.inject(case.injection(self._bus, self.drive.name), healthy)
        config = self._system.scenario.firmware.of_joint(self.drive.name)
        self.drive.configure(config=config, joint=self.robot.joints[self._joint])

    def inject(self, key: str, value: Any) -> None:
        self._system.inject(key, value)

    def cut_off(self) -> None:
        """Let no command reach the drive any more."""
        self._system.inject("link.command.loss", 1.0)

    def snapshot(self) -> Any:
        return self._system.snapshot()

    def restore(self, state: Any) -> None:
        self._system.restore(state)

    def truth(self) -> bytes:
        """The physical truth now, to the bit."""
        return self._system.world.truth().tobytes()

    def go_on(self, seconds: float) -> None:
        self._system.run_until(self._system.now_ns + round(seconds * 1e9))

    def run(self, case: FaultCase) -> Trial:
        """Bring ``case`` about at the start, and go on until the drive has noticed, or twice its time has passed."""
        self.rewind()
        self.bring_about(case)
        begin = self._system.now_ns
        while self._system.now_ns - begin < 2e9 * case.within and not self.drive.fault:
            self._system.run_until(self._system.now_ns + _TICK_NS)
        after = (self._system.now_ns - begin) * 1e-9 if self.drive.fault else None
        # what it has told by then is on the bus a moment later
        state, fault, braking = self.drive.state, self.drive.fault, self.braking()
        enabled, demand = int(self._pins_out[pins.ENABLE]), int(self._pins_out[pins.CURRENT_DEMAND])
        self.go_on(2e-3)
        return Trial(case, after, state, fault, enabled, demand, braking, self.told())

    def told(self) -> tuple[tuple[int, int], ...]:
        """The drive's emergencies since the start."""
        own = self.drive.node_id
        return tuple((code, register) for _, node, code, register in self.listener.heard if node == own)

    def braking(self) -> int:
        """Counts of the current that brakes by the motor's velocity now."""
        actuator = self.robot.joints[self._joint].actuator
        velocity = self.drive.y[signals.Y_MOTOR_VELOCITY] * messages.MOTOR_RADIAN_PER_SECOND
        damping = self.drive.settings.config.quick_stop_damping
        limit = actuator.current_limit
        current = min(max(-damping * velocity / actuator.torque_per_ampere, -limit), limit)
        return round(current / actuator.ampere_per_count)


@contextmanager
def trial_bench(seed: int = 1, joint: str = JOINT) -> Iterator[TrialBench]:
    """The bench of ``joint`` in a standing robot. Raises UserError for a joint that it does not have."""
    with assemble(Request(load(SCENARIO, SETTINGS), seed, "inline", report=False)) as assembly:
        yield TrialBench(assembly, joint)
