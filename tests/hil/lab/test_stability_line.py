"""Sweeps along one axis: boundaries, intervals and metrics that are known, and what the page says of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from scipy import stats

from hil.cli import main
from hil.errors import UserError
from hil.lab.places import crossings, places
from hil.lab.stability_line import line_of, line_places
from hil.report import line_page
from tests.hil.lab.made_up import swept
from tests.support.pages import Page

DELAY = "link.command.delay=0ms..30ms:16"


def seeds_apart(seed: int, delay: float) -> bool:
    """Eight seeds with boundaries from 12.5 ms to 19.5 ms: half of them are stable up to 16 ms."""
    return delay < (12.5 + seed) * 1e-3


def made_up(seed: int, delay: float) -> dict:
    return {"com_error_max": 1e-3 * (1 + seed) + delay, "foot_slip_max": None}


def test_share_intervals_boundary_and_metrics(tmp_path: Path) -> None:
    found = line_of(line_places(swept(tmp_path, [DELAY], seeds_apart, metrics=made_up)))
    assert found.values == pytest.approx([2e-3 * n for n in range(16)])
    assert found.stable == tuple(sum(seeds_apart(s, v) for s in range(8)) for v in found.values)
    for stable, (low, high, confidence) in zip(found.stable, found.intervals, strict=True):
        assert confidence == 0.95
        assert low == pytest.approx(stats.beta.ppf(0.025, stable, 9 - stable) if stable else 0.0)
        assert high == pytest.approx(stats.beta.ppf(0.975, stable + 1, 8 - stable) if stable < 8 else 1.0)
    (boundary,) = found.boundaries
    assert boundary.value == pytest.approx(16e-3) and not boundary.rising
    assert boundary.low == pytest.approx(12e-3) and boundary.high == pytest.approx(20e-3)
    points = found.metrics["com_error_max"]
    assert len(points) == 16 * 8 and "foot_slip_max" not in found.metrics
    assert points[8 * 5 + 3] == (5, True, pytest.approx(4e-3 + 10e-3))


def test_what_is_stable_again_further_out_has_a_boundary_of_its_own(tmp_path: Path) -> None:
    found = line_of(line_places(swept(tmp_path, [DELAY], lambda _, d: not 0.009 < d < 0.021)))
    assert [(b.value, b.rising) for b in found.boundaries] == [
        (pytest.approx(9e-3), False),
        (pytest.approx(21e-3), True),
    ]
    one = line_of(line_places(swept(tmp_path / "s", [DELAY], lambda *_: True)))
    assert one.boundaries == []
    assert line_page.sentences(one)[-1] == "no boundary: most runs are stable at all values"


def test_crossings_lie_on_a_line_between_two_values() -> None:
    assert crossings([1.0, 3.0], [1.0, 0.2]) == [(pytest.approx(2.25), 0)]
    assert crossings([1.0, 4.0], [1.0, 0.0], log=True) == [(pytest.approx(2.0), 0)]
    assert crossings([1.0, 2.0, 3.0], [0.5, 0.4, 0.5]) == [(1.0, 0), (3.0, 1)]
    assert crossings([1.0, 2.0], [0.0, 0.0]) == []


def test_the_page_s_numbers_are_the_table_s(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = swept(tmp_path / "m", [DELAY], seeds_apart, metrics=made_up)
    assert main(["map", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "half of the runs are stable at 16 ms" in printed and "the side of 12 ms and of 20 ms" in printed
    page = Page(out / "map.html")
    rows = page.rows(0)
    found = line_of(places(out))
    assert len(rows) == 17
    for value, stable, (low, high, _) in zip(found.values, found.stable, found.intervals, strict=True):
        cells = rows[found.quantity.shown(value)]
        assert cells[:2] == [f"{stable} of 8", f"{100 * low:.1f} % to {100 * high:.1f} %"]
    assert "<slipped>" in page.text and not any(link.startswith("http") for link in page.links)
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")
    record = json.loads((out / "map.json").read_text())
    assert record["stable"] == list(found.stable) and record["boundaries"][0]["value"] == pytest.approx(16e-3)


def test_choices_have_a_page_too(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = swept(tmp_path / "m", ["firmware.law=PD_m,PID_m"], lambda _, law: law == "PID_m", metrics=made_up_law)
    assert main(["map", str(out), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["values"], record["stable"], record["boundaries"]) == (["PD_m", "PID_m"], [0, 8], [])
    assert main(["map", str(out), "--predict"]) == 2
    assert "firmware.law is no number" in capsys.readouterr().err


def made_up_law(seed: int, law: str) -> dict:
    return {"com_error_max": 1e-3 * seed}


def test_an_axis_of_several_is_left_by_where(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = swept(tmp_path / "m", [DELAY, "joint.torque_gain=1,2"], lambda s, d, g: d < 0.01 * g, seeds=2)
    assert main(["map", str(out), "--where", "joint.torque_gain=2"]) == 0
    assert "half of the runs are stable at 19 ms" in capsys.readouterr().out
    with pytest.raises(UserError, match=r"has to leave one axis, and hold the others: joint\.torque_gain"):
        line_places(out)
    assert main(["map", str(out), "--where", "joint.torque_gain=2", "--x", "joint.torque_gain"]) == 2
    assert "not both" in capsys.readouterr().err


def test_the_pair_on_either_side_is_of_one_seed_and_next_to_each_other(tmp_path: Path) -> None:
    def stands(seed: int, delay: float, gain: float) -> bool:
        return delay < (0.011 + 0.002 * seed) * gain

    out = swept(tmp_path / "m", [DELAY, "joint.torque_gain=0.5,1,2"], stands, 2)
    pair = places(out).pair()
    assert pair is not None
    stable, unstable = (tuple(values.values()) for values in (pair.stable, pair.unstable))
    assert stands(pair.seed, *stable) and not stands(pair.seed, *unstable)
    assert sum(a != b for a, b in zip(stable, unstable, strict=True)) == 1
    assert places(swept(tmp_path / "all", [DELAY], lambda *_: True)).pair() is None
