"""Pages of margins, maps and campaigns with the runs below them: every link leads somewhere and back; videos."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import imageio_ffmpeg
import pytest

from hil.cli import main
from hil.errors import EmulationError
from hil.lab.kept import STABLE, UNSTABLE
from hil.report.html import VIDEO_FILE
from hil.report.video import FPS, require_rendering
from hil.scenario import load
from tests.hil.lab.made_up import swept
from tests.support.pages import Page

DURATION, AT = 0.3, 0.2
QUICK = [f"duration={DURATION}s", "limits.settle=0.15s", "controller.stand_at=0.05s", "world.hoist.hold=1s"]  # it hangs
SETTINGS = [word for text in QUICK for word in ("--set", text)]
LAST_SECOND = ("Last second: forces at the feet", "Last second: joint torques", "Last second: currents")


def rendering() -> bool:
    try:
        require_rendering()
    except EmulationError:
        return False
    return True


RENDERS = rendering()


def film_of(run: Path) -> float:
    """How long the video of ``run`` is, s, as the decoder counts its frames."""
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(run / VIDEO_FILE))
    return float(frames) / FPS


def linked(page: Path) -> list[Path]:
    """Where the links of ``page`` lead."""
    return [(page.parent / link).resolve() for link in Page(page).leads() if not link.startswith("#")]


def check_up_and_down(page: Path, *runs: Path) -> None:
    """``page`` leads to the reports of ``runs``, and they to it; nothing leads nowhere."""
    for run in runs:
        report = run / "report.html"
        assert report.resolve() in linked(page)
        assert linked(report)[0] == page.resolve() and "part of" in Page(report).text
    for each in (page, *[run / "report.html" for run in runs]):
        assert all(target.exists() for target in linked(each))
        assert not any(link.startswith("http") for link in Page(each).leads())


@pytest.fixture(scope="module")
def margin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A margin with both sides of its boundary kept: a jump of the delay that the watchdog bears or not."""
    out = tmp_path_factory.mktemp("margin") / "m"
    assert main([
        "margin", "stand", "--of", "link.command.delay", "--range", "0ms..16ms", "--resolution", "8ms",
        "--at", f"{AT}s", "--seeds", "1", *SETTINGS, "--out", str(out), "--video" if RENDERS else "--keep",
    ]) == 0  # fmt: skip
    return out


def test_a_margin_leads_to_both_sides_of_its_boundary(margin: Path) -> None:
    page, pair = margin / "margin.html", [margin / STABLE, margin / UNSTABLE]
    check_up_and_down(page, *pair)
    assert linked(margin / "compare.html")[0] == page.resolve()
    assert {(run / "report.html").resolve() for run in pair} <= set(linked(margin / "compare.html"))
    text = Page(page).text
    assert "0 s, seed 0: stable" in text and "8 ms, seed 0: unstable" in text
    assert "Exact configuration" in text and "one seed, which tells nothing about others" in text


def test_the_comparison_tells_where_they_part(margin: Path) -> None:
    text = Page(margin / "compare.html").text
    assert "Where they part" in text
    first = re.search(r"([\d.]+) s\s+link\.command: injected: (.*)", text)
    assert first is not None and float(first[1]) == pytest.approx(AT, abs=1e-3)


def test_only_the_run_that_failed_has_last_seconds(margin: Path) -> None:
    stable, unstable = (Page(margin / name / "report.html") for name in (STABLE, UNSTABLE))
    for title in LAST_SECOND:
        assert title in unstable.text and title not in stable.text
    assert "What came first" in unstable.text and "What came first" not in stable.text
    assert unstable.tags.count("img") == stable.tags.count("img") + len(LAST_SECOND)


@pytest.mark.skipif(not RENDERS, reason="no off-screen OpenGL")
def test_videos_last_as_long_as_their_runs_and_come_again_by_a_replay(margin: Path, tmp_path: Path) -> None:
    page = Page(margin / "margin.html")
    assert page.tags.count("video") == 2
    assert [film_of(margin / name) for name in (STABLE, UNSTABLE)] == [
        pytest.approx(DURATION, abs=1.5 / FPS), pytest.approx(AT, abs=2 / FPS),
    ]  # fmt: skip
    run = tmp_path / "m" / UNSTABLE
    shutil.copytree(margin, tmp_path / "m")
    before = (run / "report.html").read_text(encoding="utf-8")
    film = (run / VIDEO_FILE).read_bytes()
    (run / VIDEO_FILE).unlink()
    (run / "report.html").write_text("")
    assert main(["replay", str(run), "--video"]) == 0
    assert (run / "report.html").read_text(encoding="utf-8") == before
    assert abs(len((run / VIDEO_FILE).read_bytes()) - len(film)) < 0.1 * len(film)
    check_up_and_down(tmp_path / "m" / "margin.html", run)


def test_a_map_leads_to_both_sides_of_its_boundary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    axes = ["link.command.delay=0ms,8ms", "joint.torque_gain=1,1.1"]
    out = swept(tmp_path, axes, lambda _s, delay, _g: delay < 1e-3, 1, scenario=load("stand", QUICK), at=AT)
    assert main(["map", str(out)]) == 0
    assert not linked(out / "map.html") and "hil map" in Page(out / "map.html").text
    assert main(["map", str(out), "--keep"]) == 0
    check_up_and_down(out / "map.html", out / STABLE, out / UNSTABLE)
    text = Page(out / "map.html").text
    assert "link.command.delay = 0 s, joint.torque_gain = 1, seed 0: stable" in text
    capsys.readouterr()


CAMPAIGN = """
scenario = "stand"
at = "0.2s"
set = { duration = "0.35s", "controller.stand_at" = "0.05s", "world.hoist.hold" = "1s", "limits.settle" = "0.15s" }

[[row]]
name = "nothing much"
faults = { "bus.left_leg.loss" = 0.001 }

[[row]]
name = "cut <at once>"
faults = { "bus.left_leg.node.left_knee.cut" = true }
"""


def test_a_campaign_leads_to_what_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "mine.toml", tmp_path / "out"
    file.write_text(CAMPAIGN)
    assert main(["campaign", str(file), "--out", str(out), *(["--video"] if RENDERS else [])]) == 1
    capsys.readouterr()
    page = Page(out / "report.html")
    (run,) = [path.parent for path in out.glob("*/run.json")]
    check_up_and_down(out / "report.html", run)
    assert page.tags.count("video") == int(RENDERS)
    trials = page.rows(0)
    assert trials["cut <at once>"][2] == "not as expected" and trials["nothing much"][2] == "as expected"
    assert all(title in Page(run / "report.html").text for title in LAST_SECOND)
    if RENDERS:
        assert film_of(run) == pytest.approx(0.3, abs=2 / FPS)
