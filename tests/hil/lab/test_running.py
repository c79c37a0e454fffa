"""A run that goes on as far as it is told to is the run of its scenario, whatever way it took."""

from pathlib import Path

import pytest

from hil.commands.replay import replay
from hil.errors import UserError
from hil.lab.running import Running
from hil.run import Request, run
from hil.scenario import load

SETTINGS = {"duration": "0.3s", "controller.stand_at": "0.05s", "bus.left_leg.jitter": "20us"}


def test_in_steps_and_back_it_is_the_run_in_one_go(tmp_path: Path) -> None:
    inject = [{"at": "0.2s", "key": "link.command.delay", "value": "1ms"}]
    whole = run(Request(load("stand", SETTINGS, inject), 3, "inline", report=False))
    with Running(load("stand", SETTINGS), 3) as running:
        settled = running.until(0.1).snapshot()
        running.inject("bus.left_leg.loss", 0.5)
        running.until("0.25s")
        elsewhere = running.snapshot()
        running.restore(settled)
        running.until(0.2).inject("link.command.delay", "1ms")
        outcome = running.finish()
        assert outcome.digest == whole.digest and outcome.metrics == whole.metrics
        running.save(tmp_path / "kept")
        running.restore(elsewhere)
        assert [entry["key"] for entry in running.outcome().record["injected"]] == ["bus.left_leg.loss"]
    same, sentence = replay(tmp_path / "kept", tmp_path / "again")
    assert same, sentence
    assert (tmp_path / "again" / "left_leg.log").stat().st_size > 10_000
    again, sentence = replay(tmp_path / "again")
    assert again, sentence


def test_what_waits_for_the_next_tick_is_in_the_snapshot() -> None:
    with Running(load("stand", SETTINGS), 0) as running:
        running.until(0.1).inject("link.command.delay", "1ms")
        waiting = running.snapshot()
        first = running.until(0.15).outcome().digest
        running.restore(waiting)
        assert running.until(0.15).outcome().digest == first
        assert len(running.outcome().record["injected"]) == 1


@pytest.mark.parametrize("time", [0.05, 0.31, float("nan"), "soon"])
def test_times_that_cannot_be_gone_to(time: float | str) -> None:
    with Running(load("stand", SETTINGS), 0) as running:
        running.until(0.1)
        with pytest.raises(UserError, match="until"):
            running.until(time)
