"""A study of some seconds from its runs to its page; ended and gone on; mistakes in one sentence."""

import json
from functools import partial
from pathlib import Path

import pytest

from hil.cli import main
from hil.errors import UserError
from hil.lab.axes import axis
from hil.lab.cell_journal import CELLS_FILE
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.linear.questions import LinearPlan, oscillation
from hil.lab.quantity import quantity
from hil.lab.workers import parallel
from hil.scenario import load
from hil.studies import STUDIES
from hil.studies.study import Answers, Claim, Findings, Loops, Runs, Study, Table

QUICK = (
    "duration=0.8s", "limits.settle=0.7s", "world.hoist.hold=0.3s", "world.hoist.release=0.2s",
    "controller.stand_at=0.2s",
)  # fmt: skip
STANDS = (*QUICK[:1], "limits.settle=0.7s", *QUICK[2:])


def _conclude(found: dict[str, Answers]) -> Findings:
    shares = found["runs"].grid("share")
    return Findings(
        (Claim("Nothing is claimed.", "holds", (f"{shares.sum():g} of {shares.size}.",)),),
        (Table("Shares", ("share",), tuple((f"{s:g}",) for s in shares),),), (),
    )  # fmt: skip


def _parts(quick: bool) -> tuple:
    return (
        Runs("runs", "stand", QUICK, ("controller.task_bandwidth=0.5,30",), 1, ("com_error_max",)),
        Loops("loops", "stand", STANDS, ("controller.task_damping=1,2",), at=1.2),
    )


TINY = Study("tiny", "Tiny", "nothing", _parts, _conclude)
runner = partial(parallel, jobs=1)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Answers]]:
    out = tmp_path_factory.mktemp("study") / "out"
    return out, TINY.run(out, runner)[0]


def test_loops_are_those_of_the_standing_robot(done: tuple[Path, dict[str, Answers]]) -> None:
    scenario = load("stand", list(STANDS))
    damping = quantity(scenario, "controller.task_damping")
    with OperatingPoint(scenario, 1.2) as home, home.elsewhere(damping, 2.0) as point:
        expected = oscillation(point.linearise())
    found = done[1]["loops"].rows[1]
    assert found == {
        key: pytest.approx(value) if isinstance(value, float) else value for key, value in expected.items()
    }


def test_runs_have_their_verdicts(done: tuple[Path, dict[str, Answers]]) -> None:
    first, second = done[1]["runs"].rows
    assert (first["share"], first["ends"]) == (1.0, "stable")
    assert first["com_error_max"] > 0.0
    assert second["share"] == 0.0
    assert second["ends"] != "stable"


def test_it_goes_on_where_it_was_ended(done: tuple[Path, dict[str, Answers]]) -> None:
    out, found = done
    cells = out / "loops" / CELLS_FILE
    lines = cells.read_bytes().splitlines(keepends=True)
    cells.write_bytes(lines[0] + lines[1][:-9])  # a kill in the middle of the second
    asked = []

    def watched(function, calls):
        asked.extend(call[-1] for call in calls)
        return runner(function, calls)

    assert [a.rows for a in TINY.run(out, watched)[0].values()] == [a.rows for a in found.values()]
    assert asked == [(1, 0)]


def test_the_command_from_runs_to_page(
    done: tuple[Path, dict[str, Answers]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = done[0]
    monkeypatch.setitem(STUDIES, "tiny", TINY)
    assert main(["study", "tiny", "--out", str(out), "--jobs", "1"]) == 0
    told = capsys.readouterr().out
    assert "Nothing is claimed. It holds here.\n  1 of 2.\n" in told
    assert "Nothing is claimed." in (out / "study.html").read_text()
    assert main(["study", "tiny", "--out", str(out), "--jobs", "1", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["claims"][0]["verdict"] == "holds"
    assert record["answers"]["runs"]["axes"] == {"controller.task_bandwidth": [0.5, 30.0]}
    assert main(["study", "list"]) == 0
    assert "bandwidth " in capsys.readouterr().out


def test_the_directory_of_something_else_is_refused(done: tuple[Path, dict[str, Answers]]) -> None:
    other = Loops("loops", "stand", STANDS, ("controller.task_damping=1,3",), at=1.2)
    with pytest.raises(UserError, match=r"holds another sweep: axes\.0\.values\.1 is 2\.0 there, 3\.0 here"):
        other.run(done[0] / "loops", runner, lambda _: None)


def test_an_unknown_study_is_told_in_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "bandwith"]) == 2
    assert capsys.readouterr().err == "hil: study bandwith: there is none of that name; did you mean 'bandwidth'?\n"


def test_a_linear_loop_varies_one_fixed_quantity() -> None:
    scenario = load("stand")
    axes = tuple(axis(scenario, f"{key}=1,2") for key in ("controller.task_damping", "joint.torque_gain"))
    with pytest.raises(UserError, match=r"controller\.task_damping and joint\.torque_gain: only one"):
        LinearPlan(scenario, axes, 4.0)
