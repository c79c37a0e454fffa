"""``hil compare`` and ``hil rerun``: recorded runs beside each other, and for another viewer."""

import importlib.util
import json
from pathlib import Path

import pytest

from hil.cli import main
from hil.run import Request, run
from hil.scenario import load
from tests.support.pages import Page

SHORT = ["duration=0.5s", "controller.stand_at=0.2s", "world.hoist.hold=0.2s", "world.hoist.release=0.1s"]
LATER = [*SHORT, "limits.settle=0.4s", "link.command.delay=1ms"]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    directories = [tmp_path_factory.mktemp("compare") / name for name in ("a", "b")]
    for directory, settings in zip(directories, ([*SHORT, "limits.settle=0.4s"], LATER), strict=True):
        run(Request(load("stand", settings), 3, "inline", out=directory, report=False))
    return directories


def test_runs_side_by_side_tell_what_differs_and_by_how_much(
    records: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page"
    assert main(["compare", *map(str, records), "--out", str(out), "--png", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["differing"]) == ["link.command.delay"]
    page = Page(Path(told["page"]))
    assert "link.command.delay" in page.text
    assert all(link.startswith(("data:", "#", "../")) or not link.startswith("http") for link in page.links)
    assert [len(row) for row in page.tables[0]] == [6, 6, 6]  # a verdict per run, once
    assert list(out.glob("*.png"))
    numbers = [json.loads((d / "run.json").read_text())["metrics"]["round_trip_p50"] for d in records]
    assert numbers[1] - numbers[0] == pytest.approx(1e-3, abs=0.7e-3)  # the delay, to a tick of the servo
    assert main(["compare", *map(str, records), "--out", str(tmp_path / "again")]) == 0
    assert "link.command.delay: " in capsys.readouterr().out


def test_what_is_no_record_is_refused_with_one_sentence(
    records: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["compare", str(records[0]), str(tmp_path)], ["rerun", str(tmp_path)]):
        if command[0] == "rerun" and importlib.util.find_spec("rerun") is None:
            continue
        assert main(command) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and str(tmp_path) in error


def test_without_its_package_rerun_says_how_to_get_it(records: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    if importlib.util.find_spec("rerun") is not None:
        assert main(["rerun", str(records[0])]) == 0
        assert (records[0] / "run.rrd").stat().st_size > 10_000
        return
    assert main(["rerun", str(records[0])]) == 2
    assert "pip install" in capsys.readouterr().err
