"""An attached program that floods a bus of a run starves what arbitration says, and nothing else."""

import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bus import messages
from bus.frames import Frame
from bus.port_client import IN_FLIGHT
from bus.timing import frame_ns
from hil.control import serve_run
from hil.run import Assembly, Outcome, Request, run
from hil.scenario import load

_FLOOD = """
import sys, can
try:
    with can.Bus(interface="hil", channel=sys.argv[1]) as bus:
        message = can.Message(arbitration_id=int(sys.argv[2], 16), is_extended_id=len(sys.argv[2]) > 3, data=bytes(8))
        while True:
            bus.send(message)
except can.CanOperationError as error:
    sys.exit(0 if "has ended" in str(error) else str(error))
"""


_STANDING = 1_200_000_000  # ns; from then on all drives are switched on


def run_with(prepare: Callable[[Assembly], None], out: Path, duration: str) -> tuple[Outcome, Any]:
    """A run, and the wire of left_leg."""
    systems = []

    def keep(assembly: Assembly) -> None:
        systems.append(assembly.system)
        prepare(assembly)

    scenario = load("stand", [f"duration={duration}"])
    outcome = run(Request(scenario, seed=1, backend="inline", out=out, report=False), prepare=keep)
    return outcome, next(wire for wire in systems[0].wires if wire.name == "left_leg")


def flooded(identifier: str, out: Path, start_ns: int = 0, duration: str = "1.6s") -> tuple[Outcome, Any]:
    """The same while a process sends ``identifier`` on left_leg as fast as it is let: whenever the run looks, it fills
    all places that a client has."""
    process = None

    def attach(assembly: Assembly) -> None:
        serve_run(assembly)
        tap = assembly.tap
        server = tap._servers[[wire.name for wire in assembly.system.wires].index("left_leg")]
        poll = tap.poll

        def poll_until_no_place_is_left() -> list[tuple[int, Frame]]:
            nonlocal process
            if assembly.system.now_ns < start_ns:
                return []
            if process is None:
                process = subprocess.Popen([sys.executable, "-c", _FLOOD, f"{out.name}/left_leg", identifier],
                                           stderr=subprocess.PIPE, text=True)  # fmt: skip
            deadline = time.monotonic() + 60
            frames = poll()
            while not server.clients or len(server._clients[0]._flying) < IN_FLIGHT:
                assert time.monotonic() < deadline and process.poll() is None
                frames += poll()
            return frames

        tap.poll = poll_until_no_place_is_left

    outcome, wire = run_with(attach, out, duration)
    assert process is not None
    _, complaint = process.communicate(timeout=30)
    assert process.returncode == 0, complaint
    assert "no longer reproducible from its scenario alone" in complaint  # so it was told
    return outcome, wire


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / f"flood-{uuid.uuid4().hex[:8]}"


def test_the_lowest_priority_starves_nothing(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever the bus has left goes to the flood, and a joint's frame waits for one of its frames at most."""
    _, quiet = run_with(lambda _: None, out.with_name("quiet"), "0.4s")
    outcome, busy = flooded("1FFFFFFF", out, duration="0.4s")
    told = capsys.readouterr().err
    assert "sends on left_leg of flood-" in told and told.count("no longer reproducible") == 1
    assert outcome.stable and busy.busy_ns > 0.99 * 0.4e9 > 0.7 * 0.4e9 > quiet.busy_ns
    blocking = frame_ns(Frame(0x1FFFFFFF, bytes(8), False, False, True), 1e6, 5e6)
    before, after = quiet.waits(), busy.waits()
    states = [key for key in before if key[0] & 0x780 == messages.STATE]
    assert len(states) == 3
    for key in (*states, (messages.COMMAND, False)):
        assert after[key].frames >= before[key].frames - 1 >= 568  # the last may be under way; none while they boot
        assert before[key].longest < after[key].longest <= before[key].longest + blocking


def test_a_priority_above_the_commands_starves_these_and_the_watchdog_ends_the_run(out: Path) -> None:
    """States, whose identifiers are lower, still get through, each after one frame of the flood at most."""
    outcome, wire = flooded("1FF", out, _STANDING)
    assert outcome.exit_status == 1
    assert outcome.record["reason"] == "drive in quick stop: left_abduction, watchdog (8130h), at 1.21 s"
    waits = wire.waits()
    states = [key for key in waits if key[0] & 0x780 == messages.STATE and key[0] != 0x1FF]
    blocking = frame_ns(Frame(0x1FF, bytes(8), False, False), 1e6, 5e6)
    assert max(waits[key].longest for key in states) < 170_000 + blocking  # after two other states
    assert min(waits[key].frames for key in states) >= (1.21 - 0.02) * 1500  # none while they boot
    assert waits[(messages.COMMAND, False)].frames <= _STANDING * 1500e-9 + 1


def test_the_highest_priority_starves_all_and_the_verdict_says_so(out: Path) -> None:
    outcome, wire = flooded("001", out, _STANDING)
    assert outcome.exit_status == 1 and outcome.record["reason"].startswith("drive silent: ")
    before = _STANDING * 1500e-9 + 2
    assert all(wait.frames <= before for key, wait in wire.waits().items() if key != (1, False))
