"""A run that something came into from outside is repeated from its journal, to the bit."""

import json
import signal
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.frames import Frame
from hil.cli import main
from hil.commands.replay import replay
from hil.errors import UserError
from hil.record.journal import Journal, frame_entry, frame_of, read
from hil.run import Outcome, Request, run
from hil.scenario import load
from hil.system import Tap

SETTINGS = [
    "duration=0.35s", "controller.stand_at=0.05s", "world.hoist.hold=1s", "bus.left_leg.jitter=20us",
    "inject=[{at='0.1s', until='0.15s', key='link.command.delay', value='100us'}]",
]  # fmt: skip


class Meddler(Tap):
    """In the place of attached tools: sends frames and injects at certain controller's ticks."""

    def __init__(self, system: Any) -> None:
        self._system, self._ticks = system, 0

    def broadcast(self, *_: Any) -> None:
        pass

    def poll(self) -> list[tuple[int, Frame]]:
        self._ticks += 1
        if self._ticks == 200:
            self._system.requests.append(lambda: self._system.inject("bus.right_leg.loss", "0.02"))
            self._system.requests.append(lambda: self._system.inject("bus.left_leg.background.load", 0.1))
        if self._ticks in (100, 201, 202):
            return [(0, Frame(0x123, bytes([self._ticks]))), (1, Frame(0x1ABCDEF, b"", False, False, True))]
        return []


def meddled_with(out: Path, backend: str = "inline") -> Outcome:
    def prepare(assembly: Any) -> None:
        assembly.system.tap = Meddler(assembly.system)

    request = Request(load("stand", SETTINGS), 4, backend, out=out, report=False)
    return run(request, prepare=prepare)


@pytest.mark.parametrize("backend", ["inline", "processes"])
def test_a_meddled_run_is_repeated(tmp_path: Path, backend: str) -> None:
    outcome = meddled_with(tmp_path / "run", backend)
    record = outcome.record
    assert record["reproducible_from"] == "record" and record["tool_frames"] == 6
    assert [e["by"] for e in record["injected"]] == ["scenario", "query", "query", "scenario"] or [
        e["by"] for e in record["injected"]
    ] == ["scenario", "scenario", "query", "query"]
    same, sentence = replay(tmp_path / "run")
    assert same and sentence == f"same digest up to its end: {record['log_digest']}"
    undisturbed = run(Request(load("stand", SETTINGS), 4, "inline", report=False)).record
    assert undisturbed["reproducible_from"] == "scenario"
    assert undisturbed["log_digest"] != record["log_digest"]


def test_what_was_cut_off_is_repeated_up_to_there(tmp_path: Path) -> None:
    meddled_with(tmp_path / "run")
    journal = tmp_path / "run" / "journal.jsonl"
    content = journal.read_bytes()
    at = content.rindex(b'{"end_ns"')
    journal.write_bytes(content[: at + 20])  # killed while it wrote the last line
    same, sentence = replay(tmp_path / "run")
    assert same and sentence.startswith("same digest up to 0.3")
    journal.write_bytes(content[: content.index(b'"digest"')])
    with pytest.raises(UserError, match="ended before its first digest"):
        replay(tmp_path / "run")


def test_a_difference_is_found_and_placed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meddled_with(tmp_path / "run")
    journal = tmp_path / "run" / "journal.jsonl"
    lines = journal.read_text().splitlines()
    late = next(n for n, line in enumerate(lines) if '"frame"' in line and json.loads(line)["time_ns"] > 100_000_000)
    entry = json.loads(lines[late])
    lines[late] = json.dumps(entry | {"frame": entry["frame"] | {"data": "ff"}})
    journal.write_text("\n".join(lines) + "\n")
    assert main(["replay", str(tmp_path / "run")]) == 1
    assert capsys.readouterr().out == "the digest differs by 0.200 s\n"
    start = json.loads(lines[0])
    start["run"]["versions"]["numpy"] = "1.0"
    journal.write_text("\n".join([json.dumps(start), *lines[1:]]) + "\n")
    assert main(["replay", str(tmp_path / "run"), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["same"] is False and "(numpy 1.0 then, " in answer["sentence"]


def refused(capsys: pytest.CaptureFixture[str], directory: Path) -> str:
    assert main(["replay", str(directory)]) == 2
    return capsys.readouterr().err


START = '{"run": {"seed": 1, "configuration": {"name": "x"}}}\n'


@pytest.mark.parametrize("content, words", [
    ("", "holds nothing"), ("{}\n", "line 1 is not of"), (START + "[]\n", "line 2 is not of"),
    (START + '{"time_ns": -1, "digest": "x"}\n', "line 2"), (START + '{"time_ns": 1, "frame": {"id": 1}}\n', "line 2"),
    (START + '{"time_ns": 1, "bus": "b", "port": 1, "frame": {"id": 4096, "data": ""}}\n', "line 2"),
    (START + '{"time_ns": 1, "key": "link.state.loss", "value": 1, "by": "me"}\n', "line 2"),
    (START.replace('"x"', '"x", "robot": "atlas"') + '{"end_ns": 1, "digest": ""}\n', "no robot 'atlas'"),
    (START.replace("{\"name\"", "{\"nme\"") + '{"end_ns": 1, "digest": ""}\n', "unknown key 'nme'"),
    (START + "\udcff".encode("utf-8", "surrogateescape").decode("latin1") + "\n", "line 2"),
    (START + "[" * 5000 + "\n", "line 2"), (None, "No such file"),
])  # fmt: skip
def test_what_is_no_journal_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None, words: str
) -> None:
    if content is not None:
        (tmp_path / "journal.jsonl").write_text(content)
    assert words in refused(capsys, tmp_path)


WORDS = ["time_ns", "end_ns", "digest", "key", "value", "by", "bus", "port", "frame", "id", "data", "fd", "x"]
ENTRIES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(WORDS), inner, max_size=6),
    max_leaves=12,
)


@given(st.lists(st.binary(max_size=30) | ENTRIES.map(lambda e: json.dumps(e).encode()), max_size=4))
@settings(deadline=None)
def test_any_journal_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, lines: list[bytes]) -> None:
    directory = tmp_path_factory.getbasetemp()
    (directory / "journal.jsonl").write_bytes(START.encode() + b"".join(line + b"\n" for line in lines))
    try:
        for entry in read(directory)[1:]:
            assert isinstance(entry.get("time_ns", entry.get("end_ns")), int)
    except UserError as error:
        assert " is not of a run's journal" in str(error)


def test_a_replay_that_is_interrupted_is_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    meddled_with(tmp_path / "run")

    def interrupted(*_: Any, **__: Any) -> Outcome:
        return Outcome({"verdict": "failed", "reason": "ended by SIGINT", "log_digest": ""}, 3)

    monkeypatch.setattr("hil.run.run", interrupted)
    assert main(["replay", str(tmp_path / "run")]) == 3
    assert capsys.readouterr().err == "hil: the replay did not get to its end: ended by SIGINT\n"


def test_every_frame_survives_the_journal(tmp_path: Path) -> None:
    frames = [
        Frame(0x7FF, bytes(64)), Frame(0x1FFFFFFF, b"\x01", False, False, True),
        Frame(1, bytes(3), False, False, remote=True),
        Frame(2, b"", esi=True),
    ]  # fmt: skip
    journal = Journal(tmp_path)
    journal.write({"run": {"seed": 1, "configuration": {}}})
    for n, frame in enumerate(frames):
        journal.write(frame_entry(n, "left_leg", 5, frame))
    assert len(read(tmp_path)) == 5  # before it is closed
    journal.close()
    assert [frame_of(entry) for entry in read(tmp_path)[1:]] == frames


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_a_run_with_a_tool_and_injections_is_repeated_however_it_ended(tmp_path: Path, end: signal.Signals) -> None:
    """All of it for real: processes, python-can, the command that injects, a signal."""
    name = f"replay-{uuid.uuid4().hex[:8]}"
    out = tmp_path / name
    command = [sys.executable, "-m", "hil", "run", "stand", "--duration", "1000", "--json", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def digests() -> int:
        journal = out / "journal.jsonl"
        return journal.read_text().count('"digest"') if journal.exists() else 0

    def wait_for(count: int) -> None:
        for _ in range(1200):
            if digests() >= count:
                return
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.05)
        raise AssertionError("the run does not get on")

    try:
        wait_for(1)
        with can.Bus(interface="hil", channel=f"{name}/left_leg") as tool:
            for n in range(3):
                tool.send(can.Message(arbitration_id=0x555, data=[n], is_extended_id=False))
            inject = [sys.executable, "-m", "hil", "inject", "link.state.jitter", "30us", "--run", name]
            subprocess.run(inject, check=True, capture_output=True, timeout=60)
        wait_for(digests() + 2)
        process.send_signal(end)
        stdout, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    if end == signal.SIGINT:
        record = json.loads(stdout)
        assert (record["reproducible_from"], record["tool_frames"]) == ("record", 3)
    kinds = [next((k for k in ("key", "frame") if k in e), "") for e in read(out)]
    assert kinds.count("frame") == 3 and kinds.count("key") == 1
    same, sentence = replay(out)
    assert same and "where the run was cut off" in sentence
