"""`hil socketcan-selftest` on a real kernel with CAN, and that nothing of user-mode Linux stays behind."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from hil.cli import main
from hil.errors import UserError
from hil.selftest import uml
from hil.selftest.socketcan_selftest import TESTS

COMMAND = [sys.executable, "-m", "hil", "socketcan-selftest"]


def require_guest() -> None:
    """Skip, and say what is missing, where user-mode Linux is not installed."""
    try:
        uml.require()
    except UserError as error:
        pytest.skip(str(error))


def test_everything_works_over_a_kernel_with_can(tmp_path: Path) -> None:
    log = tmp_path / "console.log"
    done = subprocess.run([*COMMAND, "--json", "--log", str(log)], capture_output=True, text=True, timeout=400)
    if done.returncode == 2:
        pytest.skip(done.stderr)
    console = log.read_text() if log.exists() else ""
    assert done.returncode == 0, done.stdout + done.stderr + console
    answer = json.loads(done.stdout)
    outcomes = {test["name"]: (test["outcome"], test["detail"]) for test in answer["tests"]}
    print(answer["where"], *outcomes.items(), sep="\n")
    assert list(outcomes) == list(TESTS)
    may_lack = {"canopen master": "not installed", "canopen SDO": "not installed"}
    for name, (outcome, detail) in outcomes.items():
        assert outcome == "ok" or (outcome == "not run" and may_lack.get(name, "–") in detail), (name, outcome, detail)


def descendants(pid: int) -> list[int]:
    try:
        children = [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return children + [d for child in children for d in descendants(child)]


def alive(pids: list[int]) -> list[int]:
    states = {}
    for pid in pids:
        try:
            states[pid] = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
    return [pid for pid, state in states.items() if state != "Z"]


def wait(condition: object, seconds: float = 20.0) -> bool:
    """Whether ``condition()`` becomes true in time."""
    pause = threading.Event()
    for _ in range(round(seconds / 0.05)):
        if condition():  # type: ignore[operator]
            return True
        pause.wait(0.05)
    return False


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_of_a_killed_launcher(tmp_path: Path, number: signal.Signals) -> None:
    require_guest()
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [*COMMAND, "--guest", "--log", str(tmp_path / "log")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment) as launcher:
        # guard, the kernel, and at least its helper and one process of the guest
        assert wait(lambda: len(descendants(launcher.pid)) > 3)
        assert list(tmp_path.glob("hil-uml-*"))
        family = descendants(launcher.pid)
        launcher.send_signal(number)
    assert wait(lambda: not alive(family)), alive(family)
    assert not list(tmp_path.glob("hil-uml-*"))


def test_a_guest_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    require_guest()
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [*COMMAND, "--guest", "--limit", "1", "--log", str(tmp_path / "log")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode == 3
    assert done.stderr == "hil: user-mode Linux: not done within 1 s\n"
    assert not list(tmp_path.glob("hil-uml-*"))


def test_what_is_missing_is_named_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(uml, "_which", lambda name: None)
    assert main(["socketcan-selftest", "--guest"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "linux.uml, candump" in error and "apt-get install user-mode-linux can-utils" in error


@pytest.mark.parametrize("value", ["0", "x", "nan", "1e9"])
def test_a_limit_out_of_range_is_refused(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["socketcan-selftest", "--limit", value]) == 2
    assert "expected 1 to 3600 seconds" in capsys.readouterr().err


def test_the_status_of_the_guest_is_that_of_its_command() -> None:
    require_guest()
    with uml.Guest([sys.executable, "-c", "import os; os.write(1, b'a line\\n'); os._exit(5)"], 60) as guest:
        lines = list(guest)
        assert "a line" in lines
        assert guest.status == 5
