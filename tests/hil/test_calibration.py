"""Calibration: its file, finding offsets over a bus with real processes, and what a wrong offset does to a robot."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hil.calibration import bus, file
from hil.cli import main
from hil.errors import UserError
from hil.run import Request, run
from hil.scenario import load
from hil.streams import streams
from plant.config import SensorConfig
from plant.sensors import joint_encoder_offset
from robots import description
from tests.support.standalone_processes import hil, start, unique, wait_for

HUME = description.load("hume")

# --- the file ---------------------------------------------------------------------------------------------------


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(HUME.joint_names), st.floats(-3, 3).filter(lambda v: abs(v) > 1e-5)))
def test_what_is_written_is_read(tmp_path: Path, offsets: dict[str, float]) -> None:
    path = tmp_path / "calibration.toml"
    file.write(path, HUME, offsets, "by a test")
    scenario = load("stand", [f"firmware.calibration={path}"])
    known = {name: own.encoder_offset for name, own in scenario.firmware.joints.items()}
    assert known == pytest.approx(offsets, abs=1e-6)
    assert "calibration" not in json.dumps(scenario.model_dump()["firmware"])  # what is recorded needs no file


def test_a_scenario_s_own_offset_goes_before_the_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        'firmware.calibration = "robot/offsets.toml"\nfirmware.joints.left_hip.encoder_offset = "1mrad"\n'
    )
    (tmp_path / "robot").mkdir()
    file.write(tmp_path / "robot" / "offsets.toml", HUME, {"left_hip": 0.5, "left_knee": 0.25}, "by a test")
    joints = load(str(tmp_path / "mine.toml")).firmware.joints
    assert {name: own.encoder_offset for name, own in joints.items()} == {"left_hip": 0.001, "left_knee": 0.25}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('robot = "hume"\n[encoder_offset]\nleft_nee = "0.1 rad"\n', "unknown key 'encoder_offset.left_nee'"),
        ('robot = "hume"\n[encoder_offset]\nleft_knee = 0.1\n', "encoder_offset.left_knee = 0.1: "),
        ('robot = "vlca"\n[encoder_offset]\n', "it is of robot 'vlca', not of 'hume'"),
        ('robot = "hume"\n', "encoder_offset is missing"),
        ("robot = hume", "not valid TOML"),
        (None, "cannot be read"),
    ],
)
def test_a_wrong_file_is_named_with_its_mistake(tmp_path: Path, text: str | None, sentence: str) -> None:
    path = tmp_path / "calibration.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError) as caught:
        load("stand", [f"firmware.calibration={path}"])
    assert str(path) in str(caught.value) and sentence in str(caught.value)


def test_offsets_of_joints_that_there_are_not_are_refused() -> None:
    for key in ("sensors.encoder_offset.left_nee", "firmware.joints.left_nee.encoder_offset"):
        with pytest.raises(UserError, match=r"unknown key .*left_nee.*left_knee"):
            load("stand", [f"{key}=0.1rad"])


# --- over the bus -----------------------------------------------------------------------------------------------


class Still:
    """A drive's answers, without a bus."""

    def __init__(self, name: str, readings: list[float]) -> None:
        self.joint, self._readings = HUME.joint(name), iter(readings)

    def reading(self) -> float:
        return next(self._readings)

    def position(self) -> float:
        return 0.75

    def offset(self) -> float:
        return 0.25


def test_an_offset_is_the_mean_reading_less_the_posture() -> None:
    drives: list[Any] = [Still("left_hip", [0.99, 1.01]), Still("left_knee", [9.0, 9.0])]
    (hip,) = bus.measure(drives, {"left_hip": 0.7}, 2, rest=0.1)  # the knee is in no known posture
    assert (hip.joint, hip.node, hip.before) == ("left_hip", 5, 0.25)
    assert hip.offset == pytest.approx(0.3)
    assert hip.residual == pytest.approx(0.05)
    assert hip.spread == pytest.approx(0.02)


def test_a_joint_that_moves_is_not_calibrated() -> None:
    drives: list[Any] = [Still("left_hip", [0.9, 1.1])]
    with pytest.raises(UserError, match=r"left_hip moves: .* 200\.0 mrad apart"):
        bus.measure(drives, {"left_hip": 0.7}, 2, rest=0.1)


def test_all_joints_of_a_bus_are_calibrated_at_once_and_a_run_takes_the_file(tmp_path: Path) -> None:
    """Joints against a jig, as processes of their own; the run's robot has the same mountings (seed 0)."""
    name, postures, out = unique("jig"), {"left_hip": -0.6, "left_knee": 1.2}, tmp_path / "calibration.toml"
    assert hil("bus", "up", name, state=tmp_path).returncode == 0
    joints = [
        start("joint", "--joint", joint, "--can", f"hil:{name}", "--load", f"locked,at={angle}rad", "--rate", "500Hz",
              "--set", "sensors.mounting=0.3rad", "--json", state=tmp_path)
        for joint, angle in postures.items()
    ]  # fmt: skip
    common = ["joint", "calibrate", "hume", "--can", f"hil:{name}"]
    common += [f"--posture={joint}={angle}rad" for joint, angle in postures.items()]
    try:
        check = wait_for(lambda: _rows(hil(*common, "--check", "--json", state=tmp_path), 2), "two drives answer")
        true = {n: joint_encoder_offset(HUME.joint(n), SensorConfig(mounting="0.3rad"), streams(0)) for n in postures}
        for row in check["joints"]:
            assert row["residual_before_rad"] == pytest.approx(true[row["joint"]], abs=2e-4)
        found = hil(*common, "--out", str(out), "--write", "--json", state=tmp_path)
        assert found.returncode == 0, found.stderr
        for row in json.loads(found.stdout)["joints"]:
            assert row["offset_rad"] == pytest.approx(true[row["joint"]], abs=1e-4)  # a count is 0.96e-4 rad
            assert abs(row["residual_rad"]) < 2e-4
        assert hil(*common, "--check", state=tmp_path).returncode == 0
        strangers = hil("joint", "calibrate", "vlca", *common[3:5], "--posture=ankle=0", state=tmp_path)
        assert strangers.returncode == 2 and "no drive of vlca answers there" in strangers.stderr
    finally:
        for process in joints:
            process.kill()
            process.communicate()
        hil("bus", "down", name, state=tmp_path)
    scenario = load("stand", [f"firmware.calibration={out}"])
    assert {n: j.encoder_offset for n, j in scenario.firmware.joints.items()} == pytest.approx(true, abs=1e-4)


def _rows(result: Any, joints: int) -> Any:
    """The command's answer once that many joints are there."""
    if result.returncode == 2:  # a joint is still starting
        return None
    answer = json.loads(result.stdout)
    return answer if len(answer["joints"]) == joints else None


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--posture", "left_nee=1rad"], "hume has no joint 'left_nee'"),
        (["--posture", "left_knee=1"], "has no unit"),
        (["--posture", "nowhere.toml"], "neither JOINT=ANGLE nor a file"),
        (["--posture", "left_knee=1rad", "--check", "--write"], "--check only looks"),
        (["--posture", "left_knee=1rad", "--tolerance", "0"], "expected more than 0 rad"),
        (["--posture", "left_knee=1rad"], "--can hil:nowhere: "),
    ],
)
def test_a_mistake_is_named(arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["joint", "calibrate", "hume", "--can", "hil:nowhere", *arguments]) == 2
    assert sentence in capsys.readouterr().err


# --- a robot ----------------------------------------------------------------------------------------------------


def stands(*changes: str, backend: str = "inline", duration: str = "4s") -> dict[str, Any]:
    scenario = load("stand", [f"duration={duration}", *changes])
    return run(Request(scenario, seed=0, backend=backend, report=False)).record


def test_a_wrong_offset_moves_the_robot_as_far_as_geometry_says_and_its_controller_does_not_see_it() -> None:
    """An offset d of one knee moves that foot by d times its distance, and the feet's midpoint by half of that."""
    knee = HUME.joints[HUME.joint_names.index("left_knee")]
    foot = next(foot for foot in HUME.feet if foot.joint == knee.name)
    most = 0.5 * 0.05 * math.dist(foot.position, (0.0, 0.0, 0.0))
    right, wrong = stands(), stands("sensors.encoder_offset.left_knee=0.05rad")
    moved = wrong["metrics"]["com_error_max"] - right["metrics"]["com_error_max"]
    assert 0.4 * most < moved < most
    assert wrong["metrics"]["com_error_max_estimated"] < 2e-3


def test_a_robot_as_assembled_falls_and_one_that_is_calibrated_stands_alike_on_both_backends() -> None:
    config = SensorConfig(mounting="0.3rad")
    offsets = [
        f"firmware.joints.{joint.name}.encoder_offset={joint_encoder_offset(joint, config, streams(0))!r} rad"
        for joint in HUME.joints
    ]
    assembled = "sensors.mounting=0.3rad"
    assert stands(assembled)["verdict"] == "unstable"
    calibrated = [
        stands(assembled, *offsets, backend=backend, duration="2.6s") for backend in ("inline", "processes")
    ]
    assert [record["verdict"] for record in calibrated] == ["stable", "stable"]
    assert calibrated[0]["log_digest"] == calibrated[1]["log_digest"]
