"""The command: one sentence and status 2 for a mistake, one JSON object for a machine, an honest status."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import hil.run
from hil.cli import main
from hil.errors import EmulationError

RUN = f"cli-{os.getpid()}"  # not run-PID, which a run without a directory has: the fuzz targets keep one open
SHORT = ["--backend", "inline", "--duration", "0.05s"]


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The sentence of a refused command."""
    status = main(list(arguments))
    out, err = capsys.readouterr()
    assert (status, out) == (2, ""), err
    assert err.startswith("hil: ") and err.endswith("\n") and err.count("\n") == 1
    return err.removeprefix("hil: ").rstrip("\n")


RUN_HELP = "(`hil run --help` lists what there is)"
MISTAKES: dict[tuple[str, ...], str] = {
    (): "the following arguments are required: COMMAND (`hil --help` lists what there is)",
    ("run",): f"the following arguments are required: SCENARIO {RUN_HELP}",
    ("run", "nosuch.toml"): "nosuch.toml: cannot be read (No such file or directory)",
    ("run", "stnd"): "no scenario 'stnd'; did you mean 'stand'? (a file of your own ends in .toml)",
    ("run", "stand", "--seed", "-1"): f"argument --seed: '-1': expected 0, 1, 2 … {RUN_HELP}",
    ("run", "stand", "--seed", "x"): f"argument --seed: 'x': expected 0, 1, 2 … {RUN_HELP}",
    ("run", "stand", "--seed", "1.5"): f"argument --seed: '1.5': expected 0, 1, 2 … {RUN_HELP}",
    ("run", "stand", "--seed", "²"): f"argument --seed: '²': expected 0, 1, 2 … {RUN_HELP}",
    ("run", "stand", "--set", "link.command.delay"): "--set link.command.delay: expected KEY=VALUE, "
    "for example --set link.command.delay=3ms",
    ("run", "stand", "--duration", "0"): "stand: duration = 0 s: expected more than 0 s",
    ("run", "stand", "--duration", "-1"): "stand: duration = '-1s': expected at least 0 s",
    ("run", "stand", "--duration", "nan"): "stand: duration = nan: nan is not a finite number with a unit "
    "(s, ms, us, µs, ns)",
    ("run", "stand", "--duration", "abc"): "stand: duration = 'abc': 'abc' is not a number with a unit "
    "(s, ms, us, µs, ns)",
    (
        "run",
        "stand",
        "--duration",
        "",
    ): "stand: duration = '': '' is not a number with a unit (s, ms, us, µs, ns)",
    ("run", "stand", "--zenoh", "tcp/127.0.0.1:7447", "--backend", "inline"): "--zenoh has no meaning with "
    "--backend inline: nothing goes through Zenoh there",
    **{
        ("run", "stand", "--zenoh", endpoint): f"argument --zenoh: '{endpoint}': expected tcp/HOST:PORT, "
        f"for example tcp/127.0.0.1:7447 {RUN_HELP}"
        for endpoint in (
            "foo",
            "tcp/127.0.0.1",
            "tcp/127.0.0.1:0",
            "tcp/127.0.0.1:99999",
            "tcp/:7447",
            "udp/a:1",
        )
    },
    ("run", "stand", "--out", "a*b"): "--out a*b: the last part names the run and must not contain * $ ? #",
    ("run", "stand", "--out", "/proc/x"): "--out /proc/x: cannot be created (No such file or directory)",
    ("bench", "--duration", "0"): "--duration 0: expected 0.1 s to 3600 s",
    ("bench", "--duration", "5m"): "--duration: unit 'm' in '5m' does not fit: use one of s, ms, us, µs, ns",
    ("inject",): "inject needs KEY and VALUE, for example `hil inject link.command.delay 3ms`",
    (
        "inject",
        "link.command.dely",
        "3ms",
    ): "unknown key 'link.command.dely'; did you mean 'link.command.delay'? (`hil inject --list` lists all)",
    ("inject", "link.command.delay", "3"): "link.command.delay = '3': '3' has no unit: write one of s, ms, us, µs, ns",
    ("inject", "link.command.loss", "2"): "link.command.loss = '2': expected at most 1",
    ("inject", "link.command.delay", "3ms", "--run", "no-such-run"): "no run 'no-such-run' is going on",
}


@pytest.mark.parametrize("arguments", MISTAKES, ids=" ".join)
def test_a_mistake_gives_one_sentence(
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert refused(capsys, *arguments) == MISTAKES[arguments]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [["nonsense"], ["run", "stand", "--clock", "x"], ["run", "stand", "--bakend"],
                                       ["run", "stand", "--out"], ["run", "stand", "--backend", "x"]])  # fmt: skip
def test_a_wrong_option_names_the_help(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    assert re.search(r"\(`hil( run)? --help` lists what there is\)$", refused(capsys, *arguments))


def test_a_stance_out_of_reach_names_the_keys(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    far = ["--set", "stance.hip_height=5m", "--out", str(tmp_path / RUN)]
    assert re.match(r"stand: stance: .*lower stance.hip_height", refused(capsys, "run", "stand", *SHORT, *far))


@pytest.mark.parametrize("record", ["run.json", "signals.mcap"])
def test_a_record_is_never_overwritten(capsys: pytest.CaptureFixture[str], tmp_path: Path, record: str) -> None:
    """A run that was killed has left no run.json, but its signals."""
    (tmp_path / record).write_text("precious")
    sentence = refused(capsys, "run", "stand", *SHORT, "--out", str(tmp_path))
    assert sentence == f"--out {tmp_path}: holds the record of another run; name a new directory"
    assert (tmp_path / record).read_text() == "precious"


def test_a_file_is_no_directory_for_a_record(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert "is a file" in refused(capsys, "run", "stand", *SHORT, "--out", str(file))
    assert "Not a directory" in refused(capsys, "run", "stand", *SHORT, "--out", str(file / "below"))
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    assert "cannot be written to" in refused(capsys, "run", "stand", *SHORT, "--out", str(tmp_path / "new"))


DEMANDED = {"scenario", "seed", "backend", "clock", "verdict", "reason", "metrics", "log_digest", "realtime_factor",
            "out"}  # fmt: skip
METRICS = {"com_error_max", "com_error_rms", "internal_force_error", "internal_force_error_truth", "round_trip_p50",
           "round_trip_p99", "bus_load"}  # fmt: skip


def test_json_is_one_object_with_what_a_machine_needs(tmp_path: Path) -> None:
    """In a process of its own: nothing else may reach the standard output, from whatever library."""
    out = tmp_path / RUN
    settled = [
        "--set",
        "limits.settle=0.9s",
        "--set",
        "world.hoist.hold=0.2s",
        "--set",
        "controller.stand_at=0.2s",
    ]
    command = [sys.executable, "-m", "hil", "run", "split-terrain", "--backend", "inline", "--duration", "1", "--json",
               "--seed", "7", "--out", str(out), *settled, "--set", "world.hoist.release=0.2s"]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, ""), result
    assert result.stdout.count("\n") == 1
    record = json.loads(result.stdout)
    assert set(record) >= DEMANDED and set(record["metrics"]) >= METRICS
    assert (record["scenario"], record["seed"], record["out"]) == ("split-terrain", 7, str(out))
    metrics = record["metrics"]
    assert 0 < metrics["com_error_rms"] <= metrics["com_error_max"] < 0.05
    assert 0 < metrics["internal_force_error"] < 1 and 0 < metrics["internal_force_error_truth"] < 1
    assert 0.3e-3 < metrics["round_trip_p50"] <= metrics["round_trip_p99"] < 1e-3
    assert all(0.3 < load < 0.9 for load in metrics["bus_load"].values()) and len(metrics["bus_load"]) == 2
    assert json.loads((out / "run.json").read_text()) == record


def test_a_fall_is_status_1(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = [
        "--set",
        "link.command.loss=1",
        "--set",
        "world.hoist.hold=0.1s",
        "--set",
        "world.hoist.release=0.1s",
    ]
    assert main(["run", "stand", "--backend", "inline", "--duration", "2", "--json", "--out", str(tmp_path / RUN),
                 *arguments]) == 1  # fmt: skip
    record = json.loads(capsys.readouterr().out)
    assert record["verdict"] == "unstable" and re.match("fallen: CoM at", record["reason"])
    assert 0.2 < record["simulated_time"] < 2


def fail(*_: Any, **__: Any) -> None:
    raise EmulationError("nothing works\ntoday")


def test_json_is_printed_of_a_run_that_cannot_start(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hil.run, "run", fail)
    assert main(["run", "stand", "--json", "--out", str(tmp_path / RUN)]) == 3
    out, err = capsys.readouterr()
    assert set(json.loads(out)) >= DEMANDED and json.loads(out)["verdict"] == "failed"
    assert err == "hil: nothing works today\n"


def test_a_law_that_is_not_passive_is_told_and_not_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hil.run, "run", fail)
    changes = "firmware.law=cascade", "firmware.velocity_integral=2", "firmware.joints.left_knee.swing.ki=100"
    settings = [part for change in changes for part in ("--set", change)]
    assert main(["run", "stand", *settings, "--out", str(tmp_path / RUN)]) == 3
    note, end = capsys.readouterr().err.splitlines()
    assert note.startswith("hil: note: left_knee, firmware.swing: the cascade is not passive at low frequencies: ki = ")
    assert end == "hil: nothing works today"


def test_a_mistake_of_ours_does_not_read_as_unstable(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hil.run, "run", lambda *_, **__: 1 / 0)
    assert main(["run", "stand", "--out", str(tmp_path / "a")]) == 3
    assert "ZeroDivisionError" in capsys.readouterr().err

    def full_disk(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(hil.run, "run", full_disk)
    assert main(["run", "stand", "--out", str(tmp_path / "b")]) == 3
    assert capsys.readouterr().err == "hil: [Errno 28] No space left on device\n"


def test_a_run_too_short_to_have_numbers_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["run", "stand", *SHORT, "--out", str(tmp_path / RUN)]) == 0
    out = capsys.readouterr().out
    assert "stood to the end, which is before errors count (2.5 s)" in out
    assert "bus load    right_leg –, left_leg –" in out


def test_runs_within_one_second_get_directories_of_their_own(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda *_: "now")
    monkeypatch.setattr(hil.run, "run", fail)
    for _ in range(3):
        main(["run", "stand"])
    names = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert names == ["stand-seed0-now", "stand-seed0-now-2", "stand-seed0-now-3"]


def test_scenarios_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert main(["scenarios", "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)
    assert len(lines) == len(entries) >= 3 and all(e["description"] for e in entries)


def test_the_injectable_keys_are_listed_with_meaning_and_range(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inject", "--list"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["KEY", "RANGE", "DEFAULT", "MEANING"]
    columns = [head.index(word) for word in head.split()]
    for line in lines:
        key, range_, default, meaning = (line[a:b].strip() for a, b in zip(columns, [*columns[1:], None], strict=True))
        assert re.fullmatch(r"(link|bus|joint|motion_capture)\.[a-z_.]+", key) and len(meaning) > 3, line
        assert default or key.endswith(".damage"), line
        assert re.search(r"^-?[\d.e+]+ to [\d.e+]+( \w+)*$|, |true or false|^IDENTIFIER BIT", range_), line
    assert main(["inject", "--list", "bus.left_leg.node.left_knee"]) == 0
    part = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0].rpartition(".")[2] for line in part] == [
        "cut", "stuck_dominant", "listen_only", "one_shot", "restart", "bit_rate", "node_id", "drift"
    ]  # fmt: skip
    assert "did you mean 'bus.left_leg" in refused(capsys, "inject", "--list", "bus.left_lg.delay")
