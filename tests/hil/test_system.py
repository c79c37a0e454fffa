"""The property everything rests on: one scenario and seed, one digest, on any backend, repeated, loaded, restored."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import can
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hil.run import Request, assemble, run
from hil.scenario import load
from tests.support.pidfds import all_end

# noise, jitter, loss and bit errors on, and long enough for the drives to be enabled and the hoist to let go

ROUGH = [
    "duration=1.3s", "limits.settle=1.2s", "world.hoist.hold=0.3s", "world.hoist.release=0.2s",
    "controller.stand_at=0.2s", "link.state.jitter=50us", "link.command.loss=0.01", "bus.left_leg.jitter=20us",
    "bus.right_leg.bit_error_rate=1e-5",
]  # fmt: skip


def digest(backend: str, seed: int = 3) -> str:
    outcome = run(Request(load("split-terrain", ROUGH), seed=seed, backend=backend))
    assert outcome.record["verdict"] == "stable", outcome.record["reason"]
    metrics = outcome.record["metrics"]
    assert metrics["bus_errors"]["right_leg"] > 0  # the faults were there
    return outcome.record["log_digest"]


def _burn(stop: object) -> None:
    while not stop.is_set():  # type: ignore[attr-defined]
        sum(range(10_000))


def test_digest_is_equal_on_both_backends_repeated_and_under_load() -> None:
    reference = digest("inline")
    assert digest("inline") == reference
    assert digest("processes") == reference
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    burners = [context.Process(target=_burn, args=(stop,), daemon=True) for _ in range(2 * (os.cpu_count() or 1))]
    for burner in burners:
        burner.start()
    try:
        assert digest("processes") == reference
    finally:
        stop.set()
        for burner in burners:
            burner.join()
    assert digest("inline", seed=4) != reference


def test_the_digest_does_not_depend_on_the_kernels_that_numpy_picks_for_the_processor() -> None:
    """Which differ in the last bits: from machine to machine, and a run must not."""
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__  # type: ignore[import-not-found]

    picked = " ".join(name for name in __cpu_dispatch__ if __cpu_features__[name])
    code = (
        "from hil.run import Request, run; from hil.scenario import load; "
        "print(run(Request(load('split-terrain', ['duration=0.3s']), seed=1, backend='inline')).record['log_digest'])"
    )
    digests = set()
    for variables in ({}, {"OPENBLAS_CORETYPE": "Prescott"}, {"NPY_DISABLE_CPU_FEATURES": picked}):
        done = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, **variables}, capture_output=True, text=True, check=True
        )
        digests.add(done.stdout)
    assert len(digests) == 1


@pytest.mark.parametrize("backend", ["inline", "processes"])
def test_a_restored_run_continues_as_the_uninterrupted_one(backend: str) -> None:
    request = Request(load("split-terrain", ROUGH), seed=5, backend=backend)
    with assemble(request) as assembly:
        system = assembly.system
        system.run_until(700_000_000)
        saved = system.snapshot()
        system.run_until(900_000_000)
        world, controller = (assembly.recorder.table(n) for n in ("world", "controller"))
    with assemble(request) as assembly:  # fresh nodes
        assembly.system.run_until(10_000_000)
        began = len(assembly.recorder.table("world"))
        assembly.system.restore(saved)
        assembly.system.run_until(900_000_000)
        again = assembly.recorder.table("world")
        answered = assembly.recorder.table("controller")
    rows = len(again) - began
    assert rows > 250
    assert (again.times[-rows:] == world.times[-rows:]).all()
    assert (again.data[-rows:] == world.data[-rows:]).all()
    assert (answered.data[-rows + 5 :] == controller.data[-rows + 5 :]).all()


def children_of(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def start(tmp_path: Path) -> tuple[subprocess.Popen, list[int]]:
    """A long run in a process of its own, once it simulates; with the process ids of its children."""
    out = tmp_path / f"system-{uuid.uuid4().hex[:8]}"  # a name of its own: all processes of one user see it
    command = [sys.executable, "-m", "hil", "run", "stand", "--duration", "1000s", "--json", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = out / "left_leg.log"
    for _ in range(600):
        if log.exists() and log.stat().st_size > 0:
            break
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.05)
    children = children_of(process.pid)
    assert len(children) == 7  # six joints and the controller
    return process, children


def gone(pids: list[int]) -> bool:
    """Whether none of the processes runs any more, within a second."""
    return all_end(pids, 1.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_and_keeps_the_log(tmp_path: Path, number: signal.Signals) -> None:
    process, children = start(tmp_path)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=20)
    record = json.loads(stdout)
    assert process.returncode == 3, stderr
    assert number.name in record["reason"]
    assert record["simulated_time"] > 0
    assert gone(children)
    assert any(True for _ in can.CanutilsLogReader(next(tmp_path.iterdir()) / "left_leg.log"))


def test_the_death_of_a_joint_ends_the_run_with_its_name(tmp_path: Path) -> None:
    process, children = start(tmp_path)
    os.kill(children[2], signal.SIGKILL)
    stdout, _ = process.communicate(timeout=20)
    reason = json.loads(stdout)["reason"]
    assert process.returncode == 3
    assert str(children[2]) in reason and "SIGKILL" in reason
    assert gone(children)


def test_sigkill_of_the_launcher_leaves_no_process_and_a_readable_log(tmp_path: Path) -> None:
    process, children = start(tmp_path)
    process.kill()
    process.wait()
    process.stdout.close()
    process.stderr.close()
    assert gone(children)
    from hil.record.signals import load_tables

    assert len(load_tables(next(tmp_path.iterdir()))["world"]) > 100


def test_run_directory_is_read_back_by_stock_tools(tmp_path: Path) -> None:
    out = tmp_path / "run"
    outcome = run(Request(load("stand", ["duration=0.3s"]), seed=1, backend="inline", out=out))
    messages = list(can.CanutilsLogReader(out / "left_leg.log"))
    assert len(messages) > 1000 and messages[10].is_fd
    with open(out / "left_leg.log", encoding="ascii") as log:
        decoded = subprocess.run(
            [sys.executable, "-m", "cantools", "decode", "--single-line", str(out / "left_leg.dbc")],
            stdin=log, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
    assert "left_knee_state(" in decoded and "command(" in decoded
    assert "left_knee_heartbeat(" in decoded and "Unknown" not in decoded
    with open(out / "signals.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        count = sum(1 for _ in reader.iter_decoded_messages())
    assert count > 1000
    assert (out / "report.html").stat().st_size > 50_000
    assert json.loads((out / "run.json").read_text())["log_digest"] == outcome.record["log_digest"]
