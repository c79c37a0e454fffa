"""What came first, in runs whose cause was planted and in signals that are known."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.analysis.causes import Sign, onset, signs
from hil.lab.running import Running
from hil.scenario import load

RATE = 1500.0
QUICK = {"controller.stand_at": "0.2s", "controller.weight_ramp": "0.2s", "world.hoist.hold": "0.3s",
         "world.hoist.release": "0.2s", "limits.settle": "0.8s", "controller.path.kind": "hold"}  # fmt: skip


def ran(settings: dict[str, Any], *inject: dict[str, Any], name: str = "split-terrain") -> tuple[str, list[Sign]]:
    """The verdict's reason and the signs of a run."""
    with Running(load(name, settings, inject), 1) as running:
        outcome = running.finish()
    found = signs(outcome.tables, running.scenario)
    kept = [Sign(**sign) for sign in outcome.record["came_first"]]
    assert kept == ([] if outcome.stable else found)
    return outcome.reason, found


# --- oscillations ---------------------------------------------------------------------------------------------


@given(frequency=st.floats(4.0, 60.0), phase=st.floats(0.0, 6.28), amplitude=st.floats(0.1, 10.0))
def test_an_oscillation_that_begins_at_a_known_time(frequency: float, phase: float, amplitude: float) -> None:
    """Noise throughout, and from 3 s on a sine; its window of 1 s tells the beginning to half of that."""
    times = np.arange(0.0, 6.0, 1 / RATE)
    noise = 0.01 * amplitude * np.random.default_rng(1).standard_normal(len(times))
    values = noise + np.where(times > 3.0, amplitude * np.sin(2 * np.pi * frequency * times + phase), 0.0)
    found = onset(times, values, 0.1 * amplitude)
    assert found is not None
    time, seen, size = found
    assert abs(time - 3.0) <= 0.5
    assert abs(seen - frequency) < 0.1
    assert size == pytest.approx(amplitude, rel=0.16)  # a Hann window between two bins sees 15 % less


@pytest.mark.parametrize(
    ("what", "values"),
    [
        ("noise", lambda t: np.random.default_rng(2).standard_normal(len(t))),
        ("a step", lambda t: np.where(t > 3.0, 5.0, 0.0)),
        ("a drift that gets faster", lambda t: np.exp(2 * (t - 4.0))),
        ("a slow path", lambda t: 30.0 * np.sin(2 * np.pi * 0.5 * t)),
        ("what was there all the time", lambda t: 5.0 * np.sin(2 * np.pi * 9.0 * t)),
        ("what is over", lambda t: np.where(t < 2.0, 5.0 * np.sin(2 * np.pi * 9.0 * t), 0.0)),
        ("what is small", lambda t: np.where(t > 2.0, 0.9 * np.sin(2 * np.pi * 9.0 * t), 0.0)),
    ],
)
def test_what_is_no_beginning_oscillation(what: str, values: Any) -> None:
    times = np.arange(0.0, 4.0, 1 / RATE)
    assert onset(times, values(times), 1.0) is None


def test_too_short_or_not_finite() -> None:
    times = np.arange(0.0, 4.0, 1 / RATE)
    sine = np.where(times > 2, np.sin(50 * times), 0.0)
    assert onset(times, sine, 0.1) is not None
    assert onset(times[:1400], sine[:1400], 0.1) is None
    assert onset(times[:0], sine[:0], 0.1) is None
    sine[17] = np.nan
    assert onset(times, sine, 0.1) is None


# --- planted causes -------------------------------------------------------------------------------------------


def test_delay_makes_the_internal_force_oscillate_then_a_foot_slips() -> None:
    """Beside the linear model's prediction: that loop crosses over between 8 and 9 Hz when it is 20 ms late. 24 ms are
    clearly too late."""
    settings = {"firmware.watchdog": "50ms", "duration": "12s"}
    reason, found = ran(settings, {"at": "5s", "key": "link.command.delay", "value": "24ms"})
    assert reason.startswith("foot slipped")
    # for 24 ms no command comes, once
    assert found[0].kind == "missed frames" and found[0].time == pytest.approx(5.0, abs=0.002)
    oscillation, slip = (next(sign for sign in found if sign.kind == kind) for kind in ("oscillation", "slip"))
    assert oscillation.where == "internal force" and oscillation.time < slip.time
    assert oscillation.frequency is not None and 7.5 < oscillation.frequency < 9.5


def test_a_cable_that_is_cut() -> None:
    cut = {"at": "1s", "key": "bus.left_leg.node.left_knee.cut", "value": True}
    reason, found = ran(QUICK | {"duration": "1.3s"}, cut)
    assert "drive silent" in reason
    assert [sign.kind for sign in found[:2]] == ["missed frames", "missed frames"]
    assert all(sign.time == pytest.approx(1.0, abs=0.002) for sign in found[:2])
    assert {sign.where for sign in found[:2]} == {"states", "left_knee"}


def test_a_sensor_that_jumps_stops_its_drive() -> None:
    reason, found = ran(QUICK | {"duration": "1.3s"}, {"at": "1s", "key": "joint.left_knee.encoder", "value": "jump"})
    assert "motor encoder" in reason
    assert (found[0].kind, found[0].where, found[0].sentence) == ("drive fault", "left_knee", "motor encoder")
    assert found[0].time == pytest.approx(1.0, abs=0.005)


def test_a_foot_that_is_pulled_away() -> None:
    """A push that leaves the uphill foot nothing to press on."""
    push = {"at": "2.6s", "duration": "1s", "ramp": "0.1s", "force": ["200N", "0N", "0N"]}
    reason, found = ran({"duration": "4s", "push": [push]})
    assert reason.startswith("foot slipped")
    assert found[0].kind in ("slip", "contact loss") and found[0].where == "left_foot"
    assert found[0].time > 2.5  # where the ramp begins


def test_a_drive_that_may_give_little_saturates() -> None:
    """A quarter of the torque that standing takes of a knee, from 1 s on: a push that it cannot bear."""
    push = {"at": "1s", "duration": "1s", "ramp": "0.1s", "force": ["0N", "0N", "-600N"]}
    reason, found = ran(QUICK | {"duration": "2s", "push": [push], "limits.com_error": "1m"}, name="stand")
    assert any(sign.kind == "saturation" and "knee" in sign.where for sign in found), (reason, found)
    assert all(sign.time > 1.0 for sign in found)


def test_an_undisturbed_run_has_no_signs() -> None:
    reason, found = ran({"duration": "4s"})
    assert reason.startswith("stood to the end") and not found
