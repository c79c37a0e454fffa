"""`hil steps`: the steps of a recorded run."""

import json
from pathlib import Path

import pytest

from hil.cli import main
from hil.run import Request, run
from hil.scenario import load


@pytest.fixture(scope="module")
def stepped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("steps") / "run"
    run(Request(load("balance", ["duration=2.0s"]), 0, "inline", out=out, report=False))
    return out


def test_every_step_is_listed_and_drawn(stepped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["steps", str(stepped), "--json", "--out", str(tmp_path / "pictures")]) == 0
    told = json.loads(capsys.readouterr().out)
    metrics = json.loads((stepped / "run.json").read_text(encoding="utf-8"))["metrics"]
    (step,) = told["steps"]
    assert step["number"] == metrics["steps"] == 1 and step["swing"] == "right_foot"
    assert step["durations"]["lifting"] == pytest.approx(0.145, abs=2e-3)  # Table 7.2
    assert sum(e * e for e in step["error"]) ** 0.5 == pytest.approx(metrics["foot_placement_error_max"])
    assert step["torque_step_at_lift"] == metrics["torque_step_at_lift_max"]
    files = [Path(picture) for picture in told["pictures"]]
    assert {file.name for file in files} == {
        f"steps-{name}.png" for name in ("portraits", "placement", "paths", "timing", "orientation", "tracking")
    }
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in files)


def test_the_list_is_for_people_too(stepped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["steps", str(stepped)]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert "touch-down s" in head and row.split()[:3] == ["1", "right", "foot"]


def test_a_run_without_steps_is_told_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(Request(load("stand", ["duration=0.05s"]), 0, "inline", out=tmp_path / "run", report=False))
    assert main(["steps", str(tmp_path / "run")]) == 2
    assert "no foot has landed in this run of stand" in capsys.readouterr().err
