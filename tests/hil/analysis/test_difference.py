"""Where two records part, found where it was planted."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.candump import format_line
from bus.frames import Frame
from hil.analysis.difference import Comparison, compare
from hil.cli import main
from hil.errors import UserError
from hil.record.mcap_writer import McapWriter
from hil.record.signals import SIGNALS_FILE, load_tables
from hil.run import Request, run
from hil.scenario import load

SETTINGS = {"duration": "0.35s", "controller.stand_at": "0.05s", "world.hoist.hold": "1s"}
CORRUPT = {"at": "0.2s", "until": "0.2003s", "key": "bus.left_leg.corruption", "value": 0.25}


def recorded(out: Path, inject: tuple[dict[str, Any], ...] = (), seed: int = 4, **more: Any) -> Path:
    run(Request(load("stand", SETTINGS | more, inject), seed, "inline", out=out, report=False))
    return out


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("sound") / "run")


def test_equal_runs_do_not_part(sound: Path, tmp_path: Path) -> None:
    again = recorded(tmp_path / "again")
    found = compare(sound, again)
    assert found == Comparison([], {}, 350_000_000)
    assert main(["diff", str(sound), str(again)]) == 0


def test_one_bit_of_one_frame_of_a_copied_log(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The knee's position, bytes 4 to 7 of its state, loses or wins 2^10 counts of 1 µrad."""
    copy = tmp_path / "copy"
    shutil.copytree(sound, copy)
    lines = (copy / "left_leg.log").read_text().splitlines(keepends=True)
    at = next(n for n, line in enumerate(lines) if line.startswith("(0.25") and " 186##5" in line)
    before, _, data = lines[at].rpartition("##5")
    content = bytearray.fromhex(data)
    content[5] ^= 1 << 2
    lines[at] = f"{before}##5{content.hex().upper()}\n"
    (copy / "left_leg.log").write_text("".join(lines))

    found = compare(sound, copy)
    assert len(found.differences) == 1 and found.first is not None and not found.start
    first = found.first
    assert first.time_ns == int(lines[at][1:].partition(")")[0].replace(".", ""))
    assert (first.kind, first.node) == ("frame", "left_knee")
    assert first.what == "state 0x186 on left_leg, bit 2 of byte 5: position"
    assert first.a is not None and first.b is not None
    assert abs(float(first.a.split()[0]) - float(first.b.split()[0])) == pytest.approx(1024e-6)
    assert main(["diff", str(sound), str(copy)]) == 1
    assert "left_knee: state 0x186 on left_leg, bit 2 of byte 5: position: " in capsys.readouterr().out


def test_a_run_with_one_corrupted_frame(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The injection comes first, then the frame that it hit, then who read it."""
    other = recorded(tmp_path / "corrupted", (CORRUPT,))
    assert json.loads((other / "run.json").read_text())["deliveries"]["bus.left_leg"]["corrupted"] == 1
    found = compare(sound, other)
    assert list(found.start) == ["inject"]
    injection, frame, *rest = found.differences
    assert (injection.kind, injection.b) == ("injection", "bus.left_leg.corruption = 0.25")
    assert 200_000_000 <= injection.time_ns < frame.time_ns < 201_000_000
    assert frame.kind == "frame" and "on left_leg, bit " in frame.what
    # which frame it was: the only line of that time in either log
    stamp = f"({frame.time_ns // 10**9}.{frame.time_ns % 10**9:09d})"
    pair = [
        next(line for line in (record / "left_leg.log").read_text().splitlines() if line.startswith(stamp))
        for record in (sound, other)
    ]
    assert frame.what == "state 0x184 on left_leg, bit 5 of byte 10: velocity"  # with this seed
    ones = [bytes.fromhex(line.rpartition("##5")[2]) for line in pair]
    differing = int.from_bytes(ones[0], "little") ^ int.from_bytes(ones[1], "little")
    assert differing.bit_count() == 1
    bit = differing.bit_length() - 1
    assert f"bit {bit % 8} of byte {bit // 8}" in frame.what
    assert [d.time_ns for d in rest] == sorted(d.time_ns for d in rest) and rest[0].time_ns > frame.time_ns
    assert main(["diff", str(sound), str(other), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert not told["same"] and told["differences"][1]["node"] == frame.node


def test_a_signal_that_differs_in_its_last_bit(sound: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(sound, copy)
    tables = load_tables(sound)
    world = tables["world"]
    row, column = 137, world.index("dq.right_hip")
    world.data.setflags(write=True)
    world.data[row, column] = np.nextafter(world.data[row, column], np.inf)
    writer = McapWriter(copy / SIGNALS_FILE, {name: table.names for name, table in tables.items()})
    for name, table in tables.items():
        writer.write(name, table.times, table.data)
    writer.close()
    found = compare(sound, copy)
    assert len(found.differences) == 1 and found.first is not None
    assert (found.first.node, found.first.what) == ("world", "dq.right_hip")
    assert found.first.time_ns == world.times[row]


def test_another_seed_and_value_are_named(sound: Path, tmp_path: Path) -> None:
    other = recorded(tmp_path / "other", seed=3, **{"link.command.delay": "1ms"})
    found = compare(sound, other)
    assert found.start == {"link.command.delay": ('"0.0 s"', '"0.001 s"'), "seed": ("4", "3")}
    assert found.first is not None


def test_what_only_the_longer_run_has_is_no_difference(sound: Path, tmp_path: Path) -> None:
    longer = recorded(tmp_path / "longer", duration="0.4s")
    found = compare(sound, longer)
    assert not found.differences and list(found.start) == ["duration"] and found.until_ns == 350_000_000


def test_a_frame_that_is_missing_or_late(sound: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(sound, copy)
    lines = (copy / "right_leg.log").read_text().splitlines(keepends=True)
    removed = lines.pop(300)
    (copy / "right_leg.log").write_text("".join(lines))
    first = compare(sound, copy).first
    assert first is not None and first.b is not None and first.b.startswith(lines[300].split()[2][:3])  # the next one
    assert first.a == f"{removed.split()[2][:3]} at {removed[1:12]} s"


def test_what_is_no_record_is_refused(sound: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        compare(sound, tmp_path)
    assert main(["diff", str(sound), str(tmp_path)]) == 2


@settings(max_examples=30)
@given(st.binary(min_size=24, max_size=24), st.integers(0, 191))
def test_any_bit_of_a_state_is_found(data: bytes, bit: int) -> None:
    """Against lines as the recorder formats them."""
    from hil.analysis.difference import _frames
    from robots import description

    robot = description.load("hume")
    other = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(24, "little")
    logs = [
        "".join(format_line(t, "left_leg", Frame(0x184, content, True, True)) + "\n" for t, content in enumerate(rows))
        for rows in ((data, data, data), (data, other, data))
    ]
    found = list(_frames(robot, "left_leg", logs[0].encode(), logs[1].encode()))
    assert len(found) == 1
    assert found[0].time_ns == 1 and found[0].node == "left_abduction"
    assert f"bit {bit % 8} of byte {bit // 8}" in found[0].what
