"""Stand-alone buses and joints as real processes, for tests. Everything waits for what happens, not for time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from bus import messages
from bus.messages import Controlword, GainSet, Mode, Setpoint, State, Statusword
from robots import description

PATIENCE_S = 90.0  # for a machine that is loaded by others


def unique(name: str) -> str:
    """A name that no other test has."""
    return f"{name}-{uuid.uuid4().hex[:8]}"


def environment(state: Path) -> dict[str, str]:
    return {**os.environ, "XDG_STATE_HOME": str(state)}


def hil(*arguments: str, state: Path) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "hil", *arguments],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S, env=environment(state),
    )  # fmt: skip


def start(*arguments: str, state: Path) -> subprocess.Popen[str]:
    """The command, left running."""
    command = [sys.executable, "-m", "hil", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(state))


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """The first true value of ``condition``; looks often, and fails after PATIENCE_S."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < deadline, f"{what} did not happen"
        time.sleep(0.002)
    return value


def gone(pid: int) -> bool:
    """Whether a process has ended (its parent, which is init, may not have looked yet)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


def status(name: str, state: Path) -> dict[str, Any]:
    result = hil("bus", "status", name, "--json", state=state)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def attach(name: str, **options: Any) -> can.BusABC:
    return can.Bus(interface="hil", channel=name, fd=True, **options)


def message(identifier: int, data: bytes = bytes(8), **options: Any) -> can.Message:
    return can.Message(
        arbitration_id=identifier, data=data, is_extended_id=False, is_fd=True, bitrate_switch=True, **options
    )


def receive(bus: can.BusABC) -> can.Message:
    received = bus.recv(PATIENCE_S)
    assert received is not None
    return received


class Master:
    """Answers every report of one drive with a command, as a controller does."""

    def __init__(self, bus: can.BusABC, joint: str = "left_knee") -> None:
        robot = description.load("hume")
        self.bus = bus
        self.joint = robot.joint(joint)
        self._slot = next(b.joints.index(joint) for b in robot.buses if joint in b.joints)
        self._counter = 0
        self.state: State | None = None
        self.others: list[can.Message] = []

    def hear(self) -> State:
        """The drive's next report."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            message = self.bus.recv(PATIENCE_S)
            assert message is not None, "the drive is silent"
            if message.arbitration_id == messages.STATE + self.joint.node_id:
                self.state = messages.decode_state(bytes(message.data))
                return self.state
            self.others.append(message)
        raise AssertionError("the drive is silent")

    def say(self, controlword: int, torque: float = 0.0) -> None:
        self._counter += 1
        slots = [Setpoint()] * messages.SLOTS
        slots[self._slot] = Setpoint(controlword, Mode.TORQUE, GainSet.SWING, torque)
        data = messages.encode_command(self._counter, slots)
        message = can.Message(
            arbitration_id=messages.COMMAND, is_extended_id=False, is_fd=True, bitrate_switch=True, data=data
        )
        self.bus.send(message)

    def until(self, reached: Callable[[State], bool], controlword: int, torque: float = 0.0) -> State:
        """Repeat a command until a report satisfies ``reached``."""
        deadline = time.monotonic() + PATIENCE_S
        while not reached(state := self.hear()):
            assert time.monotonic() < deadline, f"not reached: {state}"
            self.say(controlword, torque)
        return state

    def enable(self) -> list[int]:
        """Walk the drive through its states; returns them in order."""
        walked = []
        for controlword, state in (
            (Controlword.DISABLE_VOLTAGE, Statusword.SWITCH_ON_DISABLED),
            (Controlword.SHUTDOWN, Statusword.READY_TO_SWITCH_ON),
            (Controlword.SWITCH_ON, Statusword.SWITCHED_ON),
            (Controlword.ENABLE_OPERATION, Statusword.OPERATION_ENABLED),
        ):
            reached = self.until(lambda s, want=state: s.statusword & Statusword.MASK == want, controlword)
            walked.append(reached.statusword & Statusword.MASK)
        return walked
