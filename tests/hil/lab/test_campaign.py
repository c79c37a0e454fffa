"""Campaigns: what a file may say, how rows come out, and that the built-in one knows every fault."""

import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from hil.cli import main
from hil.errors import UserError
from hil.injection import injectable
from hil.lab.campaign import run
from hil.lab.campaign_file import Campaign, builtin_campaigns, read, trials
from hil.scenario import Scenario
from hil.schema import field
from robots import description

HEAD = """
scenario = "stand"
at = "0.7s"

[set]
duration = "0.9s"
controller.stand_at = "0.2s"
controller.weight_ramp = "0.2s"
world.hoist.hold = "0.3s"
"""


def written(tmp_path: Path, rows: str, head: str = HEAD) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(head + rows)
    return str(path)


# --- the built-in one -----------------------------------------------------------------------------------------


def pattern(key: str) -> str:
    """``key`` for any bus, joint or node; a gateway's faults are its own."""
    key = re.sub(r"^bus\.[a-z_]+\.", "bus.BUS.", key)
    key = re.sub(r"\.node\.(?!gateway)[a-z_]+\.", ".node.JOINT.", key)
    return re.sub(r"^joint\.[a-z_]+\.", "joint.JOINT.", key)


def test_the_built_in_campaign_covers_every_fault() -> None:
    """A fault that is new in the registry (``hil inject --list``), or a new kind of one, needs a row."""
    assert builtin_campaigns() == ["faults"]
    campaign = read("faults")
    assert campaign.scenario == "split-terrain"
    tried: dict[str, set[str]] = {}
    for trial in trials(campaign):
        for key, value in trial.faults.items():
            tried.setdefault(pattern(key), set()).add(str(value))
    registry = injectable(description.load("hume"))
    assert {pattern(key) for key in registry} - set(tried) == set()
    for key, entry in registry.items():
        known = field(Scenario, key)
        kinds = set(known.choices) if known is not None and known.kind == "text" else set()
        missing = kinds - {entry.default} - tried[pattern(key)]
        assert not missing, f"no row of {pattern(key)} tries {', '.join(sorted(missing))}"


def test_every_known_weakness_says_why() -> None:
    assert all(len(row.known_weakness.split()) >= 6 for row in read("faults").row if row.known_weakness)


# --- files ----------------------------------------------------------------------------------------------------

ROW = '[[row]]\nname = "a"\n'


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ("", "row is missing"),
        ("[[row]]", "row.0.name is missing"),
        (ROW + "fault = 1", "row 'a': unknown key 'row.0.fault'; did you mean 'row.0.faults'?"),
        (ROW + 'expect = "fine"', "row 'a': row.0.expect = 'fine': expected 'stable' or 'safe_state'"),
        (ROW + "within = 3", "row 'a': row.0.within = 3: 3 has no unit: write one of s, ms"),
        (ROW + ROW, "row 'a': there are two of this name"),
        (ROW + "faults = { 'bus.left_leg.los' = 0.1 }", "row 'a': faults: nothing to inject at 'bus.left_leg.los';"),
        (ROW + "faults = { 'bus.left_leg.loss' = 2 }", "row 'a': bus.left_leg.loss = 2: expected at most 1"),
        (ROW + 'at = "0s"\nfaults = { "link.x" = 2 }', "row 'a': stand: unknown key 'link.x'"),
        (ROW + 'scenario = "stant"', "row 'a': no scenario 'stant'; did you mean 'stand'?"),
        (ROW + 'at = "1s"', "row 'a': at = 1 s: the scenario ends at 0.9 s"),
        (ROW + 'until = "0.5s"', "row 'a': until = 0.5 s: expected more than at, 0.7 s, to 0.9 s"),
        (ROW + 'at = "0s"\nuntil = "0.5s"', "row 'a': until = 0.5 s: what is there from the start stays; give an at"),
        (ROW + 'expect = "safe_state"\njoint = "left_knee"', "row 'a': within is missing"),
        (ROW + 'expect = "safe_state"\nwithin = "1ms"', "row 'a': joint is missing"),
        (ROW + 'expect = "safe_state"\nwithin = "1ms"\njoint = "knee"', "row 'a': joint = 'knee': no such joint"),
        (ROW + 'within = "1ms"', "row 'a': within, may_fall and joint belong to expect"),
        ("[[row", "not valid TOML"),
    ],
)
def test_mistakes_of_a_file(tmp_path: Path, rows: str, sentence: str, capsys: pytest.CaptureFixture) -> None:
    file = written(tmp_path, rows)
    with pytest.raises(UserError, match=re.escape(sentence)):
        trials(read(file))
    assert main(["campaign", file, "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_tables_may_be_nested(tmp_path: Path) -> None:
    """``controller.stand_at`` above is one of its keys among others, as in ``split-terrain``."""
    rows = ROW + 'scenario = "split-terrain"\n[row.faults]\nbus.left_leg.burst = { enter = 0.1, loss = 0.5 }'
    (trial,) = trials(read(written(tmp_path, rows)))
    assert trial.faults == {"bus.left_leg.burst.enter": 0.1, "bus.left_leg.burst.loss": 0.5}
    assert trial.scenario.controller.stand_at == 0.2 and trial.scenario.controller.path.kind == "ellipse"


def test_names_of_campaigns(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(UserError, match="no campaign 'fault'; did you mean 'faults'"):
        read("fault")
    with pytest.raises(UserError, match="cannot be read"):
        read(str(tmp_path / "none.toml"))
    assert main(["campaign", "faults", "--only", "no such row"]) == 2


# --- running --------------------------------------------------------------------------------------------------

ROWS = """
[[row]]
name = "late commands"
faults = { "link.command.delay" = "1ms" }

[[row]]
name = "cut"
faults = { "bus.left_leg.node.left_knee.cut" = true }
until = "0.75s"
expect = "safe_state"
within = "6ms"

[[row]]
name = "cut, and too little time"
faults = { "bus.left_leg.node.left_knee.cut" = true }
expect = "safe_state"
within = "4ms"

[[row]]
name = "cut, as is known"
faults = { "bus.left_leg.node.left_knee.cut" = true }
known_weakness = "no robot stands without a state of its knee, or so"

[[row]]
name = "cut, and too little time for a weakness"
faults = { "bus.left_leg.node.left_knee.cut" = true }
expect = "safe_state"
within = "4ms"
known_weakness = "it may fall, but it may not be late"

[[row]]
name = "a weakness that is none"
faults = { "link.command.delay" = "1ms" }
known_weakness = "this is what was thought of it once"

[[row]]
name = "from the start"
set = { "limits.fall_height" = 1.2 }
at = "0s"
faults = { "link.command.delay" = "1ms" }
"""
CAME_OUT = ["passed", "passed", "failed", "weak", "failed", "failed", "failed"]


def test_rows_come_out_as_expected_or_not(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    assert main(["campaign", written(tmp_path, ROWS), "--out", str(out), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert [result["status"] for result in told["results"]] == CAME_OUT
    cut = told["results"][1]
    assert 0.005 <= cut["safe_after"] <= 0.006  # the watchdog is 5 ms, a control period goes by before the injection
    assert "stops only after" in told["results"][2]["sentence"]
    assert told["results"][3]["sentence"].startswith("drive silent")
    assert told["results"][5]["sentence"].startswith("came out as expected, though it is listed as a known weakness")
    for result, status in zip(told["results"], CAME_OUT, strict=True):
        assert (result["record"] is not None) == (status != "passed")
        assert status == "passed" or (Path(result["record"]) / "run.json").exists()

    suite = ElementTree.parse(out / "junit.xml").getroot()[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("7", "4", "1")
    assert [[child.tag for child in case] for case in suite] == [
        {"passed": [], "weak": ["skipped"], "failed": ["failure"]}[status] for status in CAME_OUT
    ]
    page = (out / "report.html").read_text()
    for target in re.findall(r'href="([^"]+)"', page):
        assert (out / target).exists()
    assert page.count("href=") == 5 and "no robot stands without a state of its knee" in page


def test_results_do_not_depend_on_processes_or_on_what_ran_before(tmp_path: Path) -> None:
    campaign = read(written(tmp_path, ROWS)).model_copy(update={"seeds": (3,)})
    alone = {r.name: (r.status, r.sentence, r.safe_after) for r in run(campaign)}
    turned: Campaign = campaign.model_copy(update={"row": campaign.row[::-1]})
    assert {r.name: (r.status, r.sentence, r.safe_after) for r in run(turned, jobs=2)} == alone
