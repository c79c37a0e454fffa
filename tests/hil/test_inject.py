"""Changing a run that is going on, from another process."""

import json
import re
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from bus.ports import PortError, PortServer, find_runs
from bus.zenoh_link import keys, session_config
from hil.control import PortTap, keys_of_all_robots
from hil.errors import UserError
from hil.injection import injectable
from hil.run import Request, run
from hil.scenario import load, parse_value
from robots import description


def hil(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "hil", *arguments], capture_output=True, text=True, check=False, timeout=60
    )


@pytest.fixture(scope="module")
def going(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path, subprocess.Popen[str]]]:
    """A run that goes on: its name, directory and process."""
    name = f"inject-{uuid.uuid4().hex[:8]}"
    out = tmp_path_factory.mktemp("runs") / name
    command = [sys.executable, "-m", "hil", "run", "stand", "--duration", "1000", "--json", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = out / "left_leg.log"
    for _ in range(1200):
        if log.exists() and log.stat().st_size > 0:
            break
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.05)
    try:
        yield name, out, process
    finally:
        process.kill()
        process.wait()


def ask(endpoint: str, name: str, payload: bytes) -> dict[str, Any]:
    """The run's answer to any payload."""
    session = zenoh.open(session_config(None, endpoint))
    try:
        replies = list(session.get(keys(name).inject, payload=payload, timeout=10.0))
    finally:
        session.close()
    assert len(replies) == 1 and replies[0].ok is not None
    return json.loads(replies[0].ok.payload.to_bytes())


def test_a_run_is_changed_from_another_process_and_keeps_a_record_of_it(
    going: tuple[str, Path, subprocess.Popen[str]],
) -> None:
    name, out, process = going
    first = hil("inject", "link.command.delay", "250us", "--run", name)
    assert first.returncode == 0, first.stderr
    assert first.stdout.startswith("link.command.delay = 250us from ") and first.stdout.endswith(f" s of {name} on\n")
    assert hil("inject", "bus.left_leg.loss", "0.001", "--run", name).returncode == 0

    endpoint = find_runs()[name]["endpoint"]
    for payload in (b"", b"{", b"[" * 999, b"\xff", b"[]", b'{"key": 1}', b'{"key": [], "value": {}}', b"x" * 5000,
                    b'{"key": "duration", "value": "1s"}', b'{"key": "link.command.loss", "value": 2}',
                    b'{"key": "link.command.delay", "value": -1}', b'{"key": "bus.other.loss", "value": 0.1}',
                    b'{"key": "link.command.loss", "value": NaN}', b'{"key": "link.state.delay", "value": 1e999}',
                    ):  # fmt: skip
        assert list(ask(endpoint, name, payload)) == ["error"], payload

    assert process.poll() is None  # none of them did any harm
    process.send_signal(signal.SIGINT)
    stdout, _ = process.communicate(timeout=60)
    record = json.loads(stdout)
    assert process.returncode == 3 and "SIGINT" in record["reason"] and record["verdict"] == "failed"
    assert {"scenario", "metrics", "log_digest", "realtime_factor", "out"} <= set(record)
    injected = record["injected"]
    orders = [("link.command.delay", "250us"), ("bus.left_leg.loss", "0.001")]
    assert [(i["key"], i["value"]) for i in injected] == orders
    assert 0 < injected[0]["time_s"] < injected[1]["time_s"] < record["simulated_time"]
    assert f" {injected[0]['time_s']:.6f} s of" in first.stdout
    assert json.loads((out / "run.json").read_text()) == record


def test_without_a_run_it_is_a_mistake() -> None:
    result = hil("inject", "link.command.delay", "3ms", "--run", "no-such-run")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "hil: no run 'no-such-run' is going on\n"


def test_several_runs_must_be_told_apart(capsys: pytest.CaptureFixture[str]) -> None:
    from hil.cli import main

    names = [f"inject-{uuid.uuid4().hex[:8]}" for _ in range(2)]
    servers = [PortServer("left_leg", run=name, endpoint=None) for name in names]
    try:
        import threading

        stop = threading.Event()

        def serve() -> None:
            while not stop.wait(0.001):
                for server in servers:
                    server.poll()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            assert main(["inject", "link.command.delay", "3ms"]) == 2
            several = capsys.readouterr().err
            assert main(["inject", "link.command.delay", "3ms", "--run", names[0]]) == 2
            inline = capsys.readouterr().err
        finally:
            stop.set()
            thread.join()
    finally:
        for server in servers:
            server.close()
    assert "several runs are going on, name one with --run: " in several and all(name in several for name in names)
    assert inline == f"hil: {names[0]} runs inline, without Zenoh: put the change into its scenario as [[inject]]\n"


def test_a_name_that_is_taken_leaves_no_port_behind() -> None:
    name = f"inject-{uuid.uuid4().hex[:8]}"
    taken = PortServer("right_leg", run=name, endpoint=None)
    try:
        with pytest.raises(PortError, match="serves 'right_leg' already"):
            PortTap(name, ["left_leg", "right_leg"], None)
        PortServer("left_leg", run=name, endpoint=None).close()  # free again
    finally:
        taken.close()


def test_a_scheduled_injection_is_applied_at_its_time_and_changes_the_run() -> None:
    at = "inject=[{at='0.05s', key='bus.left_leg.bit_error_rate', value=0.001}]"
    changed = run(Request(load("stand", ["duration=0.1s", at]), seed=1, backend="inline"))
    plain = run(Request(load("stand", ["duration=0.1s"]), seed=1, backend="inline"))
    assert changed.record["log_digest"] != plain.record["log_digest"]
    (entry,) = changed.record["injected"]
    assert entry["key"] == "bus.left_leg.bit_error_rate" and 0.05 <= entry["time_s"] < 0.05 + 1 / 1500
    before, after = changed.tables["world"], plain.tables["world"]
    same = before.times < 50_000_000
    assert (before.data[same] == after.data[same]).all()


def test_every_injectable_key_is_one_of_the_scenarios_and_keeps_its_range() -> None:
    listed = injectable(description.load("hume"))
    assert listed.items() <= keys_of_all_robots().items() and len(listed) > 90
    for key, entry in listed.items():
        assert parse_value(key, entry.written(entry.default)) == entry.default, key
        bounds = re.fullmatch(r"(\S+) to (\S+?)( [\w ]+)?", entry.range)
        if entry.default == "":
            assert parse_value(key, "0x182 crc:3") == "0x182 crc:3" and parse_value(key, "5 17 2") == "5 17 2"
            beyond = ["0x182", "crc:3", "0x182 crc:3 x", "-1 2"]
        elif bounds is None:  # a choice
            for choice in re.split(r", | or ", entry.range):
                assert str(parse_value(key, choice)).lower() == choice, key
            beyond = ["9.5", "maybe"]
        else:
            low, high, unit = float(bounds[1]), float(bounds[2]), bounds[3] or ""
            whole = isinstance(entry.default, int)
            for value in (low, high):
                assert parse_value(key, f"{value:g}{unit}") == value, key
            step = 1 if whole else 1e-3
            beyond = [f"{low - step:.12g}{unit}", f"{high + step:.12g}{unit}"]
        for value in beyond:
            with pytest.raises(UserError, match=key):
                parse_value(key, value)
