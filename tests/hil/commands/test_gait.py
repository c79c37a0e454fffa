"""``hil gait``: what it prints, its exit status, its pictures, and what it refuses."""

import json
from pathlib import Path

import pytest

from hil.cli import main


def test_the_table_s_lateral_eigenvalues(capsys: pytest.CaptureFixture[str]) -> None:
    """Kim 2018, Table 7.2: 0.69, −0.81 (T is the sum of the four states)."""
    assert main(["gait", "--height", "0.86m", "--reversal-time", "0.18s", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [real for real, _ in told["eigenvalues"]] == pytest.approx([0.69, -0.81], abs=0.011)
    assert told["step_time"] == pytest.approx(0.335) and told["kappa"] == 0.4
    assert told["stable_reversal_times"] == [pytest.approx(0.1675), None]


def test_a_design_is_analysed_by_what_it_gives(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gait", "--design", "0.8", "--json"]) == 0
    designed = json.loads(capsys.readouterr().out)
    kappa, time = designed["kappa"], designed["reversal_time"]
    assert main(["gait", "--kappa", str(kappa), "--reversal-time", f"{time}s", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["eigenvalues"] == [[pytest.approx(0.8), 0.0], [pytest.approx(-0.8), 0.0]]
    assert main(["gait", "--design", "0.8", "--kappa", "0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["magnitude"] == pytest.approx(0.8)


def test_what_is_not_stable_is_status_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gait", "--reversal-time", "160ms"]) == 1
    assert "NOT stable" in capsys.readouterr().out


def test_its_pictures(tmp_path: Path) -> None:
    assert main(["gait", "--out", str(tmp_path / "new"), "--json"]) == 0
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["gait-map.png", "gait-portrait.png"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--height", "0.86"], "--height: '0.86' has no unit: write one of m, cm, mm"),
        (["--step-time", "0s"], "--step-time 0s: expected 0.001 s to 10 s"),
        (["--design", "1"], "--design 1: expected a magnitude from 0 to below 1; at 1 nothing dies away"),
        (["--design", "0.8", "--reversal-time", "0.2s"], "exclude each other"),
        (["--design", "0.1", "--kappa", "0.01"], "no reversal time gives a magnitude of 0.1"),
        (["--kappa", "nan"], "--kappa nan: expected a number from -100 to 100"),
    ],
)
def test_mistakes(arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gait", *arguments]) == 2
    assert sentence in capsys.readouterr().err
