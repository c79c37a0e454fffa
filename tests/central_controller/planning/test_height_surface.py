"""Height surfaces: derivatives against differences, continuity, the shapes of the source."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from central_controller.planning.height_surface import (
    CosineProfile,
    HeightSurface,
    Plane,
    over_blocks,
    platform,
    vault,
)
from robots.terrain import Block

PLATFORM = platform(0.86, 0.07, 0.4, 1.0, 0.3)  # Kim 2018 §4.3.1: the middle piece is 7 cm higher
VAULT = vault(-0.15, 0.80, 0.03, 0.2, 0.78)
SURFACES = [Plane(0.8), Plane(0.8, 0.2, -0.1), PLATFORM, VAULT]


@pytest.mark.parametrize("surface", SURFACES)
@given(x=st.floats(-1.0, 2.0), y=st.floats(-1.0, 1.0))
def test_derivatives_are_those_of_the_values(surface: HeightSurface, x: float, y: float) -> None:
    places = surface.places if isinstance(surface, CosineProfile) else []
    if any(abs(x - place) < 1e-3 for place, _ in places):
        x += 2e-3  # the curvature jumps there
    d = 1e-4
    _, zx, zy, zxx, zxy, zyy = surface(x, y)
    east, west, north, south = (surface(x + i * d, y + j * d) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)))
    assert zx == pytest.approx((east[0] - west[0]) / (2 * d), abs=1e-6)
    assert zy == pytest.approx((north[0] - south[0]) / (2 * d), abs=1e-6)
    assert zxx == pytest.approx((east[1] - west[1]) / (2 * d), abs=1e-4)
    assert zxy == pytest.approx((north[1] - south[1]) / (2 * d), abs=1e-6)
    assert zyy == pytest.approx((north[2] - south[2]) / (2 * d), abs=1e-6)


def test_the_platform_has_three_level_pieces_and_a_continuous_slope() -> None:
    assert [PLATFORM(x, 0.0)[0] for x in (-3.0, 0.7, 3.0)] == [0.86, pytest.approx(0.93), 0.86]
    for place, height in PLATFORM.places:
        for x in (place - 1e-9, place + 1e-9):
            value = PLATFORM(x, 0.0)
            assert value[0] == pytest.approx(height) and value[1] == pytest.approx(0.0, abs=1e-6)


def test_the_vault_is_that_of_the_source() -> None:
    """Kim 2018 (7.6), (7.7) as corrected, written out."""
    x_i, z_i, h_o, x_f, z_f = -0.15, 0.80, 0.03, 0.2, 0.78
    for x in (-0.12, -0.01):
        angle, k = (x - x_i) / -x_i * math.pi, math.pi / -x_i
        expected = (
            z_i + h_o / 2 * (1 - math.cos(angle)),
            h_o / 2 * k * math.sin(angle),
            h_o / 2 * k**2 * math.cos(angle),
        )
        value = VAULT(x, 0.0)
        assert (value[0], value[1], value[3]) == pytest.approx(expected)
    for x in (0.01, 0.19):
        fall, k = z_i + h_o - z_f, math.pi / x_f
        expected = (
            z_f + fall / 2 * (1 + math.cos(k * x)), -fall / 2 * k * math.sin(k * x), -fall / 2 * k**2 * math.cos(k * x)
        )  # fmt: skip
        value = VAULT(x, 0.0)
        assert (value[0], value[1], value[3]) == pytest.approx(expected)


def test_places_out_of_order_are_refused() -> None:
    with pytest.raises(ValueError, match="ascending x"):
        CosineProfile([(0.0, 0.8), (0.0, 0.9)])
    with pytest.raises(ValueError, match="ascending x"):
        CosineProfile([])


def test_over_blocks_it_is_as_much_higher_as_they_are() -> None:
    low = Block.model_validate({"start": "40cm", "end": "120cm", "height": "7cm"})
    high = Block.model_validate({"start": "160cm", "end": "210cm", "height": "10cm"})
    surface = over_blocks(0.8, [high, low], 0.3)
    inside = {0.0: 0.8, 0.25: 0.8, 0.55: 0.87, 0.8: 0.87, 1.05: 0.87, 1.35: 0.8, 1.45: 0.8, 1.75: 0.9, 2.3: 0.8}
    for x, height in inside.items():
        assert surface(x, 0.3)[0] == pytest.approx(height)
    assert surface(low.start, 0.0)[0] == pytest.approx(0.835)  # half a ramp lies on the block
    assert over_blocks(0.8, [], 0.3)(1.0, 0.0) == (0.8, 0.0, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError):
        over_blocks(0.8, [low, high], 0.5)
