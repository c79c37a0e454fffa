"""The pytest plugin as a user meets it: found by its entry point, in a pytest of its own."""

import json
import os
import subprocess
import sys
import tempfile
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]  # which forgets all modules that a test has imported, so none here may import ours
ROOT = Path(__file__).parents[2]
SHORT = {"duration": "0.15s", "controller.stand_at": "0.05s"}


@pytest.fixture
def user(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """Somebody who has installed the distribution: its entry points are those of pyproject.toml."""
    entries = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["pytest11"]
    installed = pytester.mkdir("installed") / "hume_hil_under_test-1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: hume-hil-under-test\nVersion: 1\n")
    lines = "".join(f"{name} = {module}\n" for name, module in entries.items())
    (installed / "entry_points.txt").write_text(f"[pytest11]\n{lines}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(installed.parent), str(ROOT)]))
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    return pytester


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "hil", *arguments], cwd=ROOT, capture_output=True, text=True)


def digest(seed: int, **settings: str) -> str:
    options = [f"--set={key}={value}" for key, value in (SHORT | settings).items()]
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / f"plugin-{os.getpid()}"  # run-PID is the name of a run without a directory
        ran = command("run", "stand", f"--seed={seed}", "--backend=inline", "--json", f"--out={out}", *options)
    assert ran.stdout, f"exit status {ran.returncode}: {ran.stderr}"
    return json.loads(ran.stdout)["log_digest"]


def test_a_run_has_what_a_test_asks_for(user: pytest.Pytester) -> None:
    user.makepyfile(
        f"""
        def test_run(hil):
            run = hil.run("stand", set={SHORT!r} | {{"link.command.delay": "3ms", "bus.left_leg.loss": 0.01}}, seed=7)
            assert run.stable, run.reason
            assert run.digest == {digest(7, **{"link.command.delay": "3ms", "bus.left_leg.loss": "0.01"})!r}
            assert run.metrics["duration"] > 0.14
            assert len(run.tables["world"]["com.z"]) == 225
            assert "seed 7, stable" in repr(run)

        def test_step_by_step(hil):
            run = hil.start("stand", set={SHORT!r}, seed=3)
            assert run.until(0.05) is run and run.time == 0.05 and run.stopped is None
            settled = run.snapshot()
            run.inject("bus.left_leg.node.left_knee.cut", True)
            run.until("100ms")
            cut = run.signals["bus"]["sent.left_leg"][-1]
            run.restore(settled)
            assert run.time == 0.05
            assert run.until(0.1).signals["bus"]["sent.left_leg"][-1] > cut
            verdict = run.finish()
            assert verdict.stable and verdict.digest == {digest(3)!r}
            assert verdict.record["injected"] == []
        """
    )
    user.runpytest_subprocess("-q").assert_outcomes(passed=2)


@pytest.mark.parametrize("workers", [[], ["-n2"]], ids=["alone", "xdist"])
def test_a_failing_test_leaves_its_last_runs_with_their_reports(user: pytest.Pytester, workers: list[str]) -> None:
    user.makepyfile(
        f"""
        import pytest

        @pytest.mark.hil_seeds([4, 9])
        def test_falls(hil):
            run = hil.start("stand", set={SHORT!r} | {{"limits.fall_height": 1.5}})
            run.until(0.01).inject("link.command.jitter", "0.1ms")
            assert run.finish().stable, run.stopped

        @pytest.mark.xfail
        def test_expected_to_fail(hil):
            assert not hil.run("stand", set={SHORT!r}).stable

        def test_stands(hil):
            assert hil.run("stand", set={SHORT!r}).stable
        """
    )
    arguments = ["--tb=no", "--show-capture=no", "--html=all.html", "--junit-xml=all.xml", *workers]
    result = user.runpytest_subprocess(*arguments)
    result.assert_outcomes(failed=2, passed=1, xfailed=1)
    reports = [Path(line.strip()) for line in result.outlines if line.startswith("    ") and "report.html" in line]
    assert len(reports) == 2
    pages = (user.path / "all.html").read_text()
    properties = "".join(p.attrib["value"] for p in ElementTree.parse(user.path / "all.xml").iter("property"))
    for seed, report in zip((4, 9), sorted(reports), strict=True):
        assert report.is_relative_to(user.path / ".pytest_cache" / "d" / "hil") and f"seed{seed}" in str(report)
        text = report.read_text()
        assert f"stand, seed {seed}" in text and "fallen: CoM" in text
        assert report.as_uri() in pages and str(report) in properties
        assert (report.parent / "signals.mcap").stat().st_size > 10_000
    repeated = command("replay", str(reports[0].parent))
    assert repeated.returncode == 0 and repeated.stdout.startswith("same digest up to its end"), repeated
    assert sorted(p.name for p in (user.path / ".pytest_cache" / "d" / "hil").iterdir()) == [
        f"test_a_failing_test_leaves_its_last_runs_with_their_reports.py_test_falls_seed{seed}" for seed in (4, 9)
    ]


def test_a_test_that_passes_again_keeps_nothing(user: pytest.Pytester) -> None:
    test = "def test_it(hil):\n    assert hil.run('stand', set={'duration': '10ms'}).stable is {}"
    path = user.path / "test_it.py"
    for wanted in (False, True):
        path.write_text(test.replace("{}", str(wanted)))
        user.runpytest_subprocess("-q", "--hil-reports=kept").assert_outcomes(failed=not wanted, passed=int(wanted))
        assert (user.path / "kept" / "test_it.py_test_it" / "1" / "run.json").exists() is not wanted


def test_seeds_and_faults_by_marker_and_option(user: pytest.Pytester) -> None:
    user.makepyfile(
        f"""
        import pytest

        @pytest.mark.hil_faults("link.command.delay=1ms", "bus.left_leg.loss=0.5 and link.state.loss=0.25")
        def test_from_the_start(hil):
            link = hil.run("stand", set={SHORT!r}).record["configuration"]
            assert (link["link"]["command"]["delay"], link["link"]["state"]["loss"]) in ((0.001, 0.0), (0.0, 0.25))

        @pytest.mark.hil_seeds(range(5, 6))
        @pytest.mark.hil_faults("link.command.delay=1ms", at="0.1s", until="0.12s")
        def test_at_a_time(hil, hil_seed):
            run = hil.run("stand", set={SHORT!r})
            assert run.record["seed"] == hil_seed == 5
            assert [e["key"] for e in run.record["injected"]] == ["link.command.delay"] * 2

        def test_without(tmp_path):
            pass
        """
    )
    result = user.runpytest_subprocess("-v", "--hil-seeds=2")
    result.assert_outcomes(passed=6)
    result.stdout.fnmatch_lines_random(
        [
            "*::test_from_the_start?seed1-link.command.delay=1ms? PASSED*",
            "*::test_from_the_start?seed0-bus.left_leg.loss=0.5 and link.state.loss=0.25? PASSED*",
            "*::test_at_a_time?seed5-link.command.delay=1ms? PASSED*",
        ]
    )


MISTAKES = {
    "hil.run('stant')": "no scenario 'stant'; did you mean 'stand'? (a file of your own ends in .toml)",
    "hil.run('stand', set={'link.comand.delay': '1ms'})": "stand: unknown key 'link.comand'; did you mean 'link.*",
    "hil.run('stand', set={'link.command.delay': 3})": "stand: link.command.delay = 3: 3 has no unit: write *",
    "run.inject('link.comand.delay', '1ms')": "no quantity *; did you mean 'link.command.delay'?",
    "run.inject('link.command.delay', 'soon')": "link.command.delay = 'soon': *",
    "run.until(11)": "until 11 s: expected 0 s, now, to 10 s, where the scenario ends",
    "hil.run('stand', set={'stance.hip_height': '2m'})": "stand: stance: *",
}


def test_a_mistake_is_told_in_one_sentence(user: pytest.Pytester) -> None:
    calls = "".join(f"\ndef test_{n}(hil, run):\n    {call}\n" for n, call in enumerate(MISTAKES))
    fixture = "import pytest\n@pytest.fixture\ndef run(hil):\n    return hil.start('stand')\n"
    user.makepyfile(fixture + calls)
    result = user.runpytest_subprocess("-q")
    result.assert_outcomes(failed=len(MISTAKES))
    result.stdout.fnmatch_lines([f"E*UserError: {sentence}" for sentence in MISTAKES.values()])
    assert "scenario.py" not in result.stdout.str(), "the way to it is no help"


@pytest.mark.parametrize(
    ("marker", "sentence"),
    [
        ("hil_seeds([-1])", "hil_seeds takes a number of seeds or a list of them"),
        ("hil_faults('a=1', from_='3s')", "hil_faults takes texts KEY=VALUE, for example*"),
    ],
)
def test_a_wrong_marker_is_an_error_of_its_test(user: pytest.Pytester, marker: str, sentence: str) -> None:
    user.makepyfile(f"import pytest\n@pytest.mark.{marker}\ndef test_it(hil): pass")
    result = user.runpytest_subprocess("-q", "--strict-markers")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([f"*::test_it: {sentence}"])
    assert "pytest_plugin.py" not in result.stdout.str()


def test_whoever_does_not_use_it_pays_nothing() -> None:
    """Beside pytest it imports the standard library only."""
    program = (
        "import sys, pytest; before = set(sys.modules); import hil.pytest_plugin; "
        "print({name.split('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names))"
    )
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "{'hil'}"
