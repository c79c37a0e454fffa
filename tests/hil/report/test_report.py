"""The report: complete, self-contained, and drawn from what there is."""

import base64
import copy
import json
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.analysis.latency import state_latencies
from hil.record.signals import Signals
from hil.report.page import write_report
from hil.report.plots import draw, envelope
from hil.run import Outcome, Request, run
from hil.scenario import load, validate

SETTINGS = [
    "duration=1.2s", "limits.settle=0.9s", "world.hoist.hold=0.2s", "world.hoist.release=0.2s",
    "controller.stand_at=0.2s", "bus.left_leg.bit_error_rate=1e-4", "link.state.jitter=20us",
    "push=[{at='1s', duration='0.1s', force=['-5N', '0N', '0N']}]",
    "inject=[{at='1s', key='link.command.delay', value='1ms'}]", "description=<b>soft</b> & stiff",
]  # fmt: skip


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action")]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    out = tmp_path_factory.mktemp("report") / "run"
    return run(Request(load("split-terrain", SETTINGS), seed=1, backend="inline", out=out))


@pytest.fixture(scope="module")
def page(outcome: Outcome) -> str:
    return (Path(outcome.record["out"]) / "report.html").read_text(encoding="utf-8")


def test_the_page_is_self_contained(page: str) -> None:
    parsed = Page(page)
    assert len(parsed.links) == 6 and all(link.startswith("data:image/png;base64,") for link in parsed.links)
    for link in parsed.links:
        assert base64.b64decode(link.partition(",")[2]).startswith(b"\x89PNG")
    assert not re.search(r"https?://|@import|url\(|<script|<link", page)


def test_the_page_holds_verdict_injections_numbers_and_all_plots(page: str, outcome: Outcome) -> None:
    text = Page(page).text
    record = outcome.record
    assert f"stable: {record['reason']}" in text
    injections = (
        "bus.left_leg.bit_error_rate = 0.0001 from the start",
        "link.state.jitter = 0.02 ms from the start",
        "push of (-5, 0, 0) N at 1 s",
        "link.command.delay = 1ms from 1.000 s on",
    )
    for injected in injections:
        assert injected in text
    for title in ("Centre of mass in the sagittal plane", "Internal force between the feet", "Joint torques",
                  "Bus load and frame latency", "Control-cycle latency"):  # fmt: skip
        assert title in text
    assert f"{1e3 * record['metrics']['com_error_max']:.4g}mmlimit 50 mm" in text
    assert record["log_digest"][:16] in text
    assert "<b>soft</b> & stiff" in text and Page(page).tags.count("b") == 1  # escaped


def test_the_configuration_in_the_page_repeats_the_run(page: str) -> None:
    text = re.findall(r"<pre>(.*?)</pre>", page, re.DOTALL)[0]
    configuration = tomllib.loads(Page(text).text)
    assert validate(configuration) == load("split-terrain", SETTINGS)


def test_a_value_beyond_its_limit_stands_out(outcome: Outcome, tmp_path: Path, page: str) -> None:
    assert 'class="beyond"' not in page
    record = copy.deepcopy(outcome.record)
    record["metrics"]["com_error_max"] = 0.0501
    changed = write_report(tmp_path, record, outcome.tables).read_text(encoding="utf-8")
    assert re.findall(r'class="beyond"><td>([^<]*)<', changed) == ["CoM error, largest"]


@pytest.mark.parametrize("channel", ["world", "controller", "drives", "bus"])
def test_a_record_full_of_gaps_is_drawn(outcome: Outcome, tmp_path: Path, channel: str) -> None:
    tables = dict(outcome.tables)
    table = tables[channel]
    tables[channel] = Signals(table.times, table.names, np.full_like(table.data, np.nan))
    record = {**outcome.record, "metrics": {}}
    assert all(plot.png for plot in draw(record, tables, tmp_path))
    assert write_report(tmp_path, record, tables).exists()


def test_a_run_that_failed_early_has_a_report(tmp_path: Path) -> None:
    early = run(Request(load("stand", ["duration=0.03s"]), backend="inline", out=tmp_path / "run"))
    json.dumps(early.record, allow_nan=False)
    assert (tmp_path / "run" / "report.html").exists()


def test_frame_latencies_are_those_of_the_bus(outcome: Outcome) -> None:
    """Without faults the first state of a sample waits for nothing: it takes its own frame time."""
    out = Path(outcome.record["out"])
    times, clean = state_latencies(out / "right_leg.log", 3000.0, 1500.0)
    _, disturbed = state_latencies(out / "left_leg.log", 3000.0, 1500.0)
    assert len(clean) == pytest.approx(3 * 1500 * (1.2 - 0.02), abs=6)  # nothing is sent while the drives boot
    assert times[-1] == pytest.approx(1.2, abs=1e-3)
    sampled = times - clean
    ticks = sampled * 1500
    assert np.abs(ticks - np.round(ticks)).max() < 1e-5
    assert 50e-6 < clean.min() < 100e-6 < np.median(clean) < clean.max() < 400e-6
    assert disturbed.max() > clean.max()  # repetitions


def test_frame_latencies_survive_the_counters_wrap_and_foreign_lines(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    k = 3 * 65536 + 5
    at = k * 10**9 // 1500 + 80_000
    counter = (k & 0xFFFF).to_bytes(2, "little").hex().upper()
    log.write_text(
        f"(0.000100000) b 200##5{'00' * 8}\n({at // 10**9}.{at % 10**9:09d}) b 185##5{counter}{'00' * 22}\n(1.0) b x\n"
    )
    times, latencies = state_latencies(log, 3000.0, 1500.0)
    assert times.tolist() == [pytest.approx(at * 1e-9)] and latencies.tolist() == [pytest.approx(80e-6)]
    log.write_text("")
    assert [len(a) for a in state_latencies(log, 3000.0, 1500.0)] == [0, 0]


def test_thinning_keeps_the_extremes() -> None:
    x = np.arange(100_000.0)
    y = np.sin(x / 7000.0)
    y[[1234, 77_777]] = 9.0, -9.0
    thin_x, thin_y = envelope(x, y)
    assert len(thin_x) < 4000 and (thin_y.max(), thin_y.min()) == (9.0, -9.0)
    assert (np.diff(thin_x) >= 0).all() and thin_x[thin_y.argmax()] == 1234
    short: tuple[Any, Any] = envelope(x[:100], y[:100])
    assert short[0] is not None and len(short[0]) == 100
