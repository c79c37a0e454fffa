"""Maps of sweeps whose boundary is known, and the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.cli import main
from hil.errors import UserError
from hil.lab.stability_map import load_map
from hil.report import map_page
from tests.hil.lab.made_up import swept

GRID = ["link.command.delay=0ms..30ms:31", "joint.torque_gain=0.25..4:5:log"]


def boundary_of(gain: float) -> float:
    """Falls from 20 ms at ¼ to 8 ms at 4."""
    return 14e-3 - 3e-3 * np.log2(gain)


def within(seed: int, delay: float, gain: float) -> bool:
    return delay < boundary_of(gain) + 1e-3 * (seed - 3.5)  # seeds differ by ± 3.5 ms


def test_the_boundary_lies_where_half_of_the_seeds_are_stable(tmp_path: Path) -> None:
    found = load_map(swept(tmp_path / "m", GRID, within))
    assert found.shape == (5, 31) and found.x_log is False and found.y_log is True
    assert found.nominal == (0.0, 1.0)
    _, boundary, band = map_page._draw(found, ())
    points = np.concatenate(boundary)
    rows = {gain: points[np.isclose(points[:, 1], gain), 0].mean() for gain in (0.25, 0.5, 1.0, 2.0, 4.0)}
    for gain, delay in rows.items():
        assert delay == pytest.approx(boundary_of(gain), abs=1.01e-3)
    edges = np.concatenate(band)
    for gain in (0.5, 1.0, 2.0):
        delays = edges[np.isclose(edges[:, 1], gain), 0]
        # eight of eight are stable up to − 3.5 ms, none is from + 3.5 ms on, on a grid of 1 ms
        assert delays.min() == pytest.approx(boundary_of(gain) - 3.5e-3, abs=1.1e-3)
        assert delays.max() == pytest.approx(boundary_of(gain) + 3.5e-3, abs=1.1e-3)


@pytest.mark.parametrize(("seeds", "confidence"), [(1, 0.0), (2, 0.5), (4, 0.875), (5, 0.9375), (6, 0.95), (8, 0.95)])
def test_unanimous_seeds_decide_with_the_confidence_that_they_have(
    tmp_path: Path, seeds: int, confidence: float
) -> None:
    found = load_map(swept(tmp_path / "m", GRID, lambda seed, d, g: d < boundary_of(g), seeds))
    assert found.confidence == pytest.approx(confidence)
    if seeds > 1:
        assert (found.decided == np.where(found.share == 1, 1, -1)).all()
        split = load_map(swept(tmp_path / "s", GRID, lambda seed, d, g: seed > 0, seeds))
        assert (split.decided == 0).all()


def test_scattered_samples_find_the_boundary_too(tmp_path: Path) -> None:
    axes = ["link.command.delay=0ms..30ms", "joint.torque_gain=0.25..4:log"]
    found = load_map(swept(tmp_path / "m", axes, lambda _, d, g: d < boundary_of(g), 2, "sobol:512"))
    assert found.shape is None and len(found.x) == 512
    _, boundary, _ = map_page._draw(found, ())
    points = np.concatenate(boundary)
    inner = (points[:, 1] > 0.35) & (points[:, 1] < 3)
    assert np.abs(points[inner, 0] - boundary_of(points[inner, 1])).max() < 2.5e-3


def test_further_axes_are_held(tmp_path: Path) -> None:
    axes = [*GRID, "bus.left_leg.loss=0,0.1"]
    out = swept(tmp_path / "m", axes, lambda seed, d, g, loss: loss == 0 and d < boundary_of(g))
    with pytest.raises(UserError, match=r"has to leave two axes, and hold the others: bus\.left_leg\.loss"):
        load_map(out)
    assert load_map(out, where={"bus.left_leg.loss": "0"}).share.max() == 1.0
    assert load_map(out, where={"bus.left_leg.loss": "0.1"}).share.max() == 0.0
    turned = load_map(out, x="bus.left_leg.loss", where={"link.command.delay": "1ms"})
    assert (turned.x_quantity.key, turned.y_quantity.key) == ("bus.left_leg.loss", "joint.torque_gain")
    for where, message in (({"bus.left_leg.loss": "0.2"}, "not swept; there are 0, 0.1"), ({"x": "0"}, "not varied")):
        with pytest.raises(UserError, match=message):
            load_map(out, where=where)


def test_the_command_draws_a_page_that_needs_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = swept(tmp_path / "m", GRID, within)
    assert main(["map", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "155 places, 8 runs each" in printed and "95 % confidence" in printed
    page = (out / "map.html").read_text()
    assert "slipped" in page and "<slipped>" not in page
    assert "<script src=" not in page and "Plotly.newPlot" in page
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("stable", [True, False])
def test_a_map_without_a_boundary_is_drawn(tmp_path: Path, stable: bool) -> None:
    out = swept(tmp_path / "m", GRID, lambda *_: stable)
    assert main(["map", str(out)]) == 0
    assert map_page._draw(load_map(out), ())[1] == []


def test_what_is_no_map_is_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["map", str(tmp_path)]) == 2
    assert "a sweep writes it when it is finished" in capsys.readouterr().err
    one = swept(tmp_path / "one", GRID[:1], lambda _, d: d < 0.01)
    with pytest.raises(UserError, match=r"a map needs two axes; there is link\.command\.delay alone"):
        load_map(one)
    laws = swept(tmp_path / "law", [GRID[0], "firmware.law=PD_m,PID_m"], lambda _, d, law: d < 0.01)
    assert main(["map", str(laws)]) == 2
    assert "firmware.law has no scale" in capsys.readouterr().err
    (one / "table.parquet").write_bytes(b"PAR1")
    assert main(["map", str(one)]) == 2
    assert "not the table of a sweep" in capsys.readouterr().err
