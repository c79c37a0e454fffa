"""The benchmark of the bus measures what it says: frames that really arrive, and nothing stays behind."""

import json
import multiprocessing

import pytest

from bus.ports import served
from hil.cli import main
from hil.commands.bench_bus import NOTES, across_processes


def test_all_five_are_measured_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "bus", "--duration", "0.1s", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert set(results) == set(NOTES)
    for name, result in results.items():
        if name.startswith("udp_multicast") and "unavailable" in result:
            assert result["unavailable"]  # no multicast on this machine: it says so
            continue
        assert result["frames_per_s"] > 1000, name
        assert 0.0 <= result["lost"] < 1.0 and result["cpu_us"] < 10_000, name
    assert not multiprocessing.active_children() and not [run for run, _ in served() if run.startswith("bench-")]


def test_a_bus_that_is_not_there_is_an_error_and_leaves_no_process() -> None:
    with pytest.raises(Exception, match="receiver"):
        across_processes({"interface": "hil", "channel": "nosuch/bench"}, 0.1)
    assert not multiprocessing.active_children()
