"""``hil export``: what it writes, that it is written the same again, and what it refuses."""

import subprocess
from pathlib import Path

import pytest

from hil.cli import main
from joint_firmware.laws import signals
from robots import pins
from tests.support.exports import need

NUMBERS = pins.N_INPUTS + signals.INPUT_SIZE  # that the example reads per step
ALWAYS = {"joint_law.h", "joint_law.c", "main.c", "Makefile", "README.md"}


def texts(directory: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in directory.iterdir()}


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one sentence that the command says."""
    assert main(["export", *arguments]) == 2
    output = capsys.readouterr()
    assert output.out == "" and output.err.count("\n") == 1
    return output.err


def test_one_joint_or_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "--robot", "hume", "--joint", "left_knee", "--out", str(tmp_path / "one")]) == 0
    one = texts(tmp_path / "one")
    assert set(one) == ALWAYS | {"hume_left_knee.c"}
    assert sorted(capsys.readouterr().out.split()) == sorted(str(tmp_path / "one" / name) for name in one)
    assert main(["export", "--out", str(tmp_path / "all")]) == 0
    every = texts(tmp_path / "all")
    assert len(every) == len(ALWAYS) + 6 and "law PID_m, double precision" in every["joint_law.c"]
    assert every["joint_law.c"].replace("all joints", "left_knee") == one["joint_law.c"]


@pytest.mark.parametrize("name", ["PD_m+DOB", "pdm+dob", "PDm + DOB", "Pd_M+doB"])
def test_a_law_has_its_name_in_any_spelling(tmp_path: Path, name: str) -> None:
    assert main(["export", "--law", name, "--out", str(tmp_path / "out")]) == 0
    assert '#define JOINT_LAW_NAME "PD_m+DOB"' in (tmp_path / "out" / "joint_law.h").read_text()


def test_again_it_writes_the_same_beside_what_its_makefile_built(tmp_path: Path) -> None:
    need("make", "make")
    out = tmp_path / "firmware"
    arguments = ["export", "--joint", "right_hip", "--precision", "single", "--out", str(out)]
    assert main(arguments) == 0
    before = texts(out)
    subprocess.run(["make"], cwd=out, check=True, capture_output=True)
    assert (out / "example").exists()
    assert main(arguments) == 0
    assert {name: (out / name).read_text() for name in before} == before


def test_a_recording_is_what_the_example_reads_and_prints(tmp_path: Path) -> None:
    need("make", "make")
    out = tmp_path / "firmware"
    assert main(["export", "--joint", "right_hip", "--recording", "split-terrain", "--out", str(out)]) == 0
    assert {path.name for path in out.glob("*.csv")} == {"recorded_right_hip.csv", "computed_right_hip.csv"}
    subprocess.run(["make"], cwd=out, check=True, capture_output=True)
    pins = (out / "recorded_right_hip.csv").read_text()
    result = subprocess.run([out / "example"], input=pins, capture_output=True, text=True, check=True)
    assert result.stdout == (out / "computed_right_hip.csv").read_text() and result.stdout.count("\n") == 3000


def test_the_example_says_what_it_cannot_read(tmp_path: Path) -> None:
    need("make", "make")
    out = tmp_path / "firmware"
    assert main(["export", "--joint", "right_hip", "--out", str(out)]) == 0
    subprocess.run(["make"], cwd=out, check=True, capture_output=True)
    good = ",".join(["1"] * NUMBERS)
    for text, complaint in (
        (good + "\n1,2\n", f"line 2: expected {NUMBERS} numbers"),
        (good + ",7\n", f"line 1: expected {NUMBERS} numbers"),
        (good.replace("1,1", "1,x", 1) + "\n", f"line 1: expected {NUMBERS} numbers"),
        ("\n", f"line 1: expected {NUMBERS} numbers"),
    ):
        result = subprocess.run([out / "example"], input=text, capture_output=True, text=True)
        assert (result.returncode, result.stderr) == (2, complaint + "\n")
    result = subprocess.run([out / "example", "left_toe"], input="", capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (2, "no joint left_toe\n")


def test_the_firmware_s_configuration_goes_into_the_tables(tmp_path: Path) -> None:
    out = tmp_path / "out"
    changes = ["firmware.torque_limit=120Nm", "firmware.rate=6kHz"]
    assert main(["export", *(word for change in changes for word in ("--set", change)), "--out", str(out)]) == 0
    assert "#define JOINT_LAW_RATE_HZ 6000\n" in (out / "joint_law.h").read_text()
    table = (out / "hume_left_hip.c").read_text()
    assert "\n    120.0," in table and f"\n    {1 / 6000!r}," in table
    assert "const joint_law_gains hume_left_hip_swing = {4.0, 20.0, 10.0};" in table


# --- mistakes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--robot", "humr"], "robot = 'humr'"),
        (["--joint", "left_kne"], "--joint left_kne: hume has none; did you mean 'left_knee'?"),
        (["--law", "LQR"], "--law LQR: there is none; valid are "),
        (["--precision", "half"], "--precision half: expected double or single"),
        (["--recording", "split"], "split"),
        (["--set", "world.rate=6kHz"], "--set world.rate=6kHz: without --recording there is firmware.… only"),
        (["--set", "firmware.stance.kq=1"], "firmware.stance.kq"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_a_mistake_gets_one_sentence_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert sentence in refused(capsys, *arguments, "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_file_and_a_directory_with_other_things_are_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    assert f"--out {file}: is a file; name a directory" in refused(capsys, "--out", str(file))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert "full: holds notes.txt, which is not of this export" in refused(capsys, "--out", str(tmp_path / "full"))
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["notes.txt"] and file.read_text() == "mine"
    below = file / "below"
    assert f"--out {below}: " in refused(capsys, "--out", str(below))
    assert "--out" in refused(capsys)  # it has to be named
