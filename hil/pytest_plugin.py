"""pytest's ``hil`` fixture: closed-loop tests of a user's own in a few lines (docs/testing.md).

    def test_survives_three_ms(hil):
        run = hil.run("split-terrain", set={"link.command.delay": "3ms"}, seed=7)
        assert run.stable, run.reason

Nothing of the emulation is imported before a test uses it.
"""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from hil.lab.running import Running
    from hil.run import Outcome

_KEPT = 3  # runs of one test of which a report is written when it fails: the last ones
_PROPERTY = "hil_report"  # of a test's report, one per run
_IN_USE = pytest.StashKey[tuple["Hil", Path]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("hil", "hume-hil")
    group.addoption(
        "--hil-seeds", type=_count, metavar="N",
        help="run every test that uses the fixture hil with the seeds 0 to N - 1, unless it is marked hil_seeds",
    )  # fmt: skip
    group.addoption(
        "--hil-reports", type=Path, metavar="DIR", help="where failing tests leave their runs (default: pytest's cache)"
    )


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text)):
        raise ValueError  # argparse names option and value
    return int(text)


_count.__name__ = "number of seeds"  # as argparse names it


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "hil_seeds(seeds): run the test with these seeds, a list of numbers, or 0 to seeds - 1"
    )
    config.addinivalue_line(
        "markers",
        "hil_faults(*faults, at=None, until=None): run the test once under each fault, a text 'KEY=VALUE', several "
        "joined by ' and ': from the start, or from the time at (until the time until)",
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "hil" not in metafunc.fixturenames:
        return
    seeds = _seeds(metafunc)
    if seeds is not None and "hil_seed" in metafunc.fixturenames:
        metafunc.parametrize("hil_seed", seeds, ids=[f"seed{seed}" for seed in seeds])
    marker = metafunc.definition.get_closest_marker("hil_faults")
    if marker is not None:
        faults = [_fault(metafunc, text, **marker.kwargs) for text in marker.args]
        metafunc.parametrize("hil_fault", faults, ids=[str(text) for text in marker.args])


def _seeds(metafunc: pytest.Metafunc) -> list[int] | None:
    marker = metafunc.definition.get_closest_marker("hil_seeds")
    if marker is None:
        count = metafunc.config.getoption("hil_seeds")
        return None if count is None else list(range(count))
    seeds = marker.args[0] if len(marker.args) == 1 and not marker.kwargs else None
    if type(seeds) is int and seeds > 0:
        return list(range(seeds))
    if isinstance(seeds, list | tuple | range) and seeds and all(type(s) is int and s >= 0 for s in seeds):
        return list(seeds)
    pytest.fail(f"{metafunc.definition.nodeid}: hil_seeds takes a number of seeds or a list of them", pytrace=False)


def _fault(metafunc: pytest.Metafunc, text: Any, at: Any = None, until: Any = None, **unknown: Any) -> dict[str, Any]:
    pairs = [part.partition("=") for part in text.split(" and ")] if isinstance(text, str) else []
    if unknown or not pairs or not all(key.strip() and value.strip() for key, _, value in pairs):
        example = "'link.command.delay=3ms', at=\"3s\""
        sentence = f"hil_faults takes texts KEY=VALUE, for example {example}"
        pytest.fail(f"{metafunc.definition.nodeid}: {sentence}", pytrace=False)
    values = {key.strip(): value.strip() for key, _, value in pairs}
    if at is None:
        return {"settings": values}
    times = {"at": at} | ({} if until is None else {"until": until})
    return {"inject": [{**times, "key": key, "value": value} for key, value in values.items()]}


@pytest.fixture
def hil_seed() -> int:
    """The seed of this test's runs that are given none: of --hil-seeds or the marker hil_seeds, else 0."""
    return 0


@pytest.fixture
def hil_fault() -> dict[str, Any]:
    """What the marker hil_faults adds to every run of this test, by argument of ``hil.scenario.load``."""
    return {}


@pytest.fixture
def hil(request: pytest.FixtureRequest, hil_seed: int, hil_fault: dict[str, Any]) -> Iterator[Hil]:
    """Runs scenarios; the last runs of a test that fails are kept, with their reports."""
    hil = Hil(hil_seed, **hil_fault)
    request.node.stash[_IN_USE] = hil, _directory(request)
    yield hil
    hil.close()


class Hil:
    """What the fixture ``hil`` is.

    Args:
        seed: of runs that are given none.
        settings: values by key that every run gets, unless it sets them itself.
        inject: injections that every run gets beside those of its scenario.
    """

    def __init__(
        self, seed: int = 0, settings: Mapping[str, Any] | None = None, inject: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        self.seed = seed
        self._settings, self._inject = dict(settings or {}), list(inject)
        self.runs: deque[Running] = deque(maxlen=_KEPT)

    def run(self, scenario: str, *, set: Mapping[str, Any] | None = None, seed: int | None = None) -> Outcome:
        """Run a scenario to its verdict: ``stable``, ``reason``, ``metrics``, ``digest``, ``tables``.

        Args:
            scenario: a built-in one, or the path of a .toml file.
            set: values by key, as ``hil run --set KEY=VALUE``.
            seed: of all random numbers; None: the test's.

        Raises UserError naming a wrong scenario, key or value and what would be right.
        """
        __tracebackhide__ = True
        with self.start(scenario, set=set, seed=seed) as running:
            return running.finish()

    def start(self, scenario: str, *, set: Mapping[str, Any] | None = None, seed: int | None = None) -> Running:
        """As ``run``, but it goes on only as far as it is told to (``hil.lab.running.Running``)."""
        __tracebackhide__ = True
        from hil.errors import UserError
        from hil.lab.running import Running
        from hil.scenario import load

        try:
            complete = load(scenario, {**self._settings, **(set or {})}, self._inject)
            running = Running(complete, self.seed if seed is None else seed)
        except UserError as error:
            raise UserError(str(error)) from None  # without the way that led to it
        self.runs.append(running)
        return running

    def close(self) -> None:
        """End all runs."""
        for running in self.runs:
            running.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.when == "call" and _IN_USE in item.stash:
        hil, directory = item.stash[_IN_USE]
        shutil.rmtree(directory, ignore_errors=True)  # of the last time that it failed
        if report.failed:
            for n, running in enumerate(hil.runs, start=1):
                _keep(report, running, directory / str(n))
            item.user_properties.extend(p for p in report.user_properties if p[0] == _PROPERTY)  # for JUnit's XML
    return report


def _directory(request: pytest.FixtureRequest) -> Path:
    """Where the runs of a test are kept if it fails: its own place, so that workers of xdist do not meet."""
    from hil.report.names import file_name

    name, config = file_name(request.node.nodeid), request.config
    chosen = config.getoption("hil_reports")
    if chosen is not None:
        return (config.invocation_params.dir / chosen / name).resolve()
    if hasattr(config, "cache"):
        return config.cache.mkdir("hil") / name
    return request.getfixturevalue("tmp_path_factory").getbasetemp() / "hil" / name


def _keep(report: pytest.TestReport, running: Running, directory: Path) -> None:
    outcome = running.outcome()
    text = f"{running.scenario.name}, seed {running.seed}, {outcome.record['verdict']}: {outcome.reason}"
    try:
        running.save(directory)
    except OSError as error:
        report.user_properties.append((_PROPERTY, f"{text}\nits record cannot be written: {error}"))
        return
    page = directory / "report.html"
    path = page if page.exists() else directory  # a run of a few milliseconds has none
    report.user_properties.append((_PROPERTY, f"{text}\n{path}"))
    try:
        from pytest_html import extras
    except ImportError:
        return
    report.extras = [*getattr(report, "extras", []), extras.url(path.as_uri(), name=text)]  # type: ignore[attr-defined]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    lines = []
    for report in terminalreporter.stats.get("failed", []):
        for name, value in getattr(report, "user_properties", ()):
            if name == _PROPERTY:
                text, path = value.split("\n")
                lines += [f"{report.nodeid}: {text}", f"    {path}"]
    if lines:
        terminalreporter.section("hil")
        for line in lines:
            terminalreporter.write_line(line)
