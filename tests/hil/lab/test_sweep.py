"""A sweep against its runs, one by one; killed and resumed, on joblib and on a real Dask cluster: one table."""

from __future__ import annotations

import contextlib
import itertools
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from hil.cli import main
from hil.lab.axes import axis
from hil.lab.cell_journal import CELLS_FILE, MANIFEST_FILE, CellJournal
from hil.lab.quantity import changed
from hil.lab.statistics import share_interval
from hil.lab.sweep import TABLE_FILE, Plan, Row, read_table, sweep
from hil.run import Request, run
from hil.scenario import load

QUICK = ["--duration", "0.8s", "--set", "limits.settle=0.7s", "--set", "world.hoist.hold=0.3s", "--set",
         "world.hoist.release=0.2s", "--set", "controller.stand_at=0.2s", "--at", "0.6s"]  # fmt: skip
SWEEP = ["sweep", "stand", "--vary", "link.command.delay=0ms..8ms:3", "--vary", "joint.torque_gain=0.5,2",
         "--seeds", "2", *QUICK]  # fmt: skip
SETTINGS = ["duration=0.8s", *(text for text in QUICK if "=" in text)]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table of SWEEP, uninterrupted, in one process."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main([*SWEEP, "--jobs", "1", "--out", str(out)]) == 0
    return out / TABLE_FILE


def test_every_row_is_the_run_that_it_stands_for(table: Path) -> None:
    rows = pq.read_table(table).to_pylist()
    assert [(row["point"], row["seed"]) for row in rows] == [(p, s) for p in range(6) for s in range(2)]
    assert {(row["link.command.delay"], row["joint.torque_gain"]) for row in rows} == {
        (delay, gain) for delay in (0.0, 4e-3, 8e-3) for gain in (0.5, 2.0)
    }
    for row in (rows[0], rows[6], rows[11]):
        injection = f'inject=[{{at="0.6s", key="link.command.delay", value="{row["link.command.delay"]!r} s"}}]'
        scenario = changed(load("stand", [*SETTINGS, injection]), {"joint.torque_gain": row["joint.torque_gain"]})
        record = run(Request(scenario, seed=row["seed"], backend="inline")).record
        assert (row["verdict"], row["reason"]) == (record["verdict"], record["reason"])
        assert row["digest"] == record["log_digest"]
        assert row["metrics.com_error_max"] == record["metrics"]["com_error_max"]
    assert {row["verdict"] for row in rows} == {"stable", "unstable"}


def test_columns_tell_their_unit_and_the_table_its_sweep(table: Path) -> None:
    schema = pq.read_schema(table)
    assert schema.field("link.command.delay").metadata == {b"unit": b"s"}
    columns, manifest = read_table(table.parent)
    assert manifest["seeds"] == 2
    assert [a["key"] for a in manifest["axes"]] == ["link.command.delay", "joint.torque_gain"]
    assert "digest" in columns


def test_the_same_command_again_runs_nothing(table: Path, capsys: pytest.CaptureFixture) -> None:
    before = table.read_bytes()
    assert main([*SWEEP, "--json", "--out", str(table.parent)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["runs_now"], result["runs"], result["points"]) == (0, 12, 6)
    assert table.read_bytes() == before


def test_another_configuration_is_refused_with_what_differs(table: Path, capsys: pytest.CaptureFixture) -> None:
    for changes, words in (
        (["--set", "controller.rate=1kHz"], "scenario.controller.rate is 1500.0 there, 1000.0 here"),
        (["--at", "0.5s"], "at is 0.6 there, 0.5 here"),
        (["--seeds", "3"], "seeds is 2 there, 3 here"),
    ):
        assert main([*SWEEP, *changes, "--out", str(table.parent)]) == 2
        assert words in capsys.readouterr().err


def cells(out: Path) -> int:
    path = out / CELLS_FILE
    return path.read_bytes().count(b"\n") if path.exists() else 0


def test_killed_at_random_and_resumed_it_gives_the_same_table(table: Path, tmp_path: Path) -> None:
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    rng = random.Random(seed)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "hil", *SWEEP, "--jobs", "2", "--out", str(out)]
    done = 0
    for _ in range(3):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        goal = min(done + rng.randint(0, 3), 11)
        while cells(out) <= goal and process.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(rng.uniform(0.01, 0.3))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert cells(out) >= done
        done = cells(out)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert (out / TABLE_FILE).read_bytes() == table.read_bytes()
    lines = [json.loads(line)["cell"] for line in (out / CELLS_FILE).read_text().splitlines()]
    assert len(lines) == len({tuple(cell) for cell in lines}) == 12  # nothing lost, nothing twice


TINY = ["sweep", "stand", "--vary", "link.command.delay=0ms..8ms:5", "--vary", "sensors.noise=0,1", "--seeds", "6",
        "--duration", "0.1s", "--set", "controller.stand_at=0.02s", "--at", "0.05s", "--jobs", "1"]  # fmt: skip


def swept_quietly(out: Path) -> None:
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
        sys.exit(main([*TINY, "--out", str(out)]))


def test_killed_ten_times_and_resumed_it_gives_the_same_table(tmp_path: Path) -> None:
    """At instants of which some are while it starts, most while it runs, and some while a line is written."""
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    rng = random.Random(seed)
    context = multiprocessing.get_context("forkserver")  # a process that has loaded everything: it starts at once
    context.set_forkserver_preload(["hil.lab.sweep", "hil.lab.experiment", "tests.hil.lab.test_sweep"])
    out = tmp_path / "out"
    done = 0
    for _ in range(10):
        process = context.Process(target=swept_quietly, args=(out,))
        process.start()
        goal = min(done + rng.randint(0, 2), 57)
        while cells(out) < goal and process.is_alive():
            process.join(0.005)
        process.join(rng.uniform(0.0, 0.15))
        alive = process.is_alive()
        process.kill()
        process.join()
        assert alive, "it ended before it was killed ten times"
        assert cells(out) >= done
        done = cells(out)
    assert not (out / TABLE_FILE).exists() and 0 < done < 60
    for directory in (out, tmp_path / "whole"):
        process = context.Process(target=swept_quietly, args=(directory,))
        process.start()
        process.join()
        assert process.exitcode == 0
    assert (out / TABLE_FILE).read_bytes() == (tmp_path / "whole" / TABLE_FILE).read_bytes()
    lines = [json.loads(line)["cell"] for line in (out / CELLS_FILE).read_text().splitlines()]
    assert len(lines) == len({tuple(cell) for cell in lines}) == 60


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[str]:
    """A Dask scheduler and two workers on loopback, each a process."""
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    processes = [
        subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show",
                          "--scheduler-file", str(file)], **quiet)
    ]  # fmt: skip
    try:
        while not (file.exists() and file.read_text().endswith("}")):
            with pytest.raises(subprocess.TimeoutExpired):
                processes[0].wait(0.1)
        processes += [
            subprocess.Popen([*dask, "worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny",
                              "--no-dashboard", "--local-directory", str(tmp_path)], **quiet)
            for _ in range(2)
        ]  # fmt: skip
        yield json.loads(file.read_text())["address"]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_a_cluster_gives_the_same_table(cluster: str, table: Path, tmp_path: Path) -> None:
    from distributed import Client

    with Client(cluster, timeout="60s") as client:
        client.wait_for_workers(2, timeout=120)
        out = tmp_path / "out"
        assert main([*SWEEP, "--cluster", cluster, "--out", str(out)]) == 0
        ran = client.run(lambda: getattr(sys.modules.get("hil.lab.sweep"), "_kept", None) is not None)
    assert list(ran.values()) == [True, True]  # both had a share
    assert (out / TABLE_FILE).read_bytes() == table.read_bytes()


def test_a_cluster_that_is_not_there_is_said(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([*SWEEP, "--cluster", "tcp://127.0.0.1:1", "--out", str(tmp_path / "o")]) == 2
    assert "no Dask scheduler answers" in capsys.readouterr().err
    assert main([*SWEEP, "--cluster", "tcp://127.0.0.1:1", "--jobs", "2"]) == 2


# --- the plan and the journal, with runs that are made up ----------------------------------------------

STAND = load("stand")
CALLS: list[tuple[int, int]] = []


def made_up(_: object, calls: list) -> Iterator[tuple[tuple[int, int], Row]]:
    """Stable up to 4 ms of delay; from there on by the seed."""
    for _scenario, _at, values, (point, seed) in calls:
        CALLS.append((point, seed))
        stable = next(iter(values.values())) < 4e-3 or seed % 2 == 0
        yield (point, seed), {
            "verdict": "stable" if stable else "unstable", "reason": "", "simulated": 1.0, "digest": "",
            "metrics": {"m": 1.0}, "simulated_here": 1.0, "cpu": 1.0,
        }  # fmt: skip


def plan(seeds: int, until_confident: bool = False) -> Plan:
    return Plan(STAND, (axis(STAND, "link.command.delay=0ms..8ms:3"),), seeds, 2.5, None, until_confident)


def test_points_that_are_clear_get_no_further_seeds(tmp_path: Path) -> None:
    CALLS.clear()
    rows = sweep(plan(9, until_confident=True), tmp_path / "a", made_up)
    enough = next(n for n in range(1, 10) if share_interval(n, n)[0] > 0.5)
    counts = [sum(cell[0] == point for cell in rows) for point in range(3)]
    assert enough == 6 and counts == [6, 9, 9]
    assert len(CALLS) == len(set(CALLS)) == 24
    assert sweep(plan(9, until_confident=True), tmp_path / "a", made_up) == rows
    assert len(CALLS) == 24


def test_cells_that_share_a_settled_part_follow_each_other() -> None:
    axes = (axis(STAND, "link.command.delay=0ms..8ms:3"), axis(STAND, "joint.torque_gain=1,2"))
    two = Plan(STAND, axes, 2, 2.5)
    order = next(two.rounds({}))
    groups = [(seed, two.fixed(two.points[point])) for point, seed in order]
    changes = sum(a != b for a, b in itertools.pairwise(groups))
    assert len(order) == 12 and changes == len(set(groups)) - 1 == 3


def test_a_line_that_was_cut_off_is_cut_away_and_run_again(tmp_path: Path) -> None:
    sweep(plan(2), tmp_path, made_up)
    path = tmp_path / CELLS_FILE
    whole, table_before = path.read_bytes(), (tmp_path / TABLE_FILE).read_bytes()
    for length in (len(whole) - 1, len(whole) - 20, whole.index(b"\n") + 5, 3, 0):
        path.write_bytes(whole[:length])
        CALLS.clear()
        sweep(plan(2), tmp_path, made_up)
        assert len(CALLS) == 6 - whole[:length].count(b"\n")
        assert sorted(path.read_bytes().splitlines()) == sorted(whole.splitlines())
        assert (tmp_path / TABLE_FILE).read_bytes() == table_before


def test_directories_of_something_else_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    command = ["sweep", "stand", "--vary", "link.command.delay=0ms..8ms:3", "--out"]
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("…")
    assert main([*command, str(tmp_path / "full")]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert (tmp_path / "full" / "thesis.tex").read_text() == "…"
    (tmp_path / "file").write_text("…")
    assert main([*command, str(tmp_path / "file")]) == 2
    sweep(plan(8), tmp_path / "damaged", made_up)
    (tmp_path / "damaged" / CELLS_FILE).write_text("{}\n")
    assert main([*command, str(tmp_path / "damaged")]) == 2
    assert "line 1 is damaged" in capsys.readouterr().err
    (tmp_path / "damaged" / MANIFEST_FILE).write_text("[")
    assert main([*command, str(tmp_path / "damaged")]) == 2


def test_two_sweeps_into_one_directory_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with CellJournal(tmp_path, plan(8).manifest()):
        assert main(["sweep", "stand", "--vary", "link.command.delay=0ms..8ms:3", "--out", str(tmp_path)]) == 2
    assert "another process is sweeping into it" in capsys.readouterr().err


def test_a_point_that_the_scenario_does_not_take_is_refused_before_anything_runs(capsys: pytest.CaptureFixture) -> None:
    assert main(["sweep", "stand", "--vary", "firmware.report_rate=1.5kHz,1.4kHz"]) == 2
    assert "firmware.rate = 3000 Hz: must be a multiple of firmware.report_rate" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("pyarrow.parquet", ["sweep", "stand", "--vary", "link.command.delay=0,1ms"]),
        ("distributed", ["sweep", "stand", "--vary", "link.command.delay=0,1ms", "--cluster", "tcp://127.0.0.1:1"]),
        ("plotly", ["map", "somewhere"]),
    ],
)
def test_a_library_that_is_missing_is_named_before_anything_runs(
    module: str, command: list[str], capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    assert main(command) == 2
    assert f"needs {module}, which is not installed: pip install 'hume-hil[lab]'" in capsys.readouterr().err
