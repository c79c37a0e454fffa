"""Quantities with units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robots.quantities import parse_quantity

UNITS = [("ms", "s", 1e-3), ("kHz", "Hz", 1e3), ("cm", "m", 1e-2), ("N", "N", 1.0)]


@given(st.floats(-1e9, 1e9), st.sampled_from(UNITS))
def test_value_times_prefix(value, unit):
    suffix, si, scale = unit
    assert parse_quantity(f"{value!r} {suffix}", si) == pytest.approx(value * scale, rel=1e-12)
    assert parse_quantity(f"{value!r}{suffix}", si) == parse_quantity(f" {value!r}  {suffix} ", si)


def test_degrees():
    assert parse_quantity("180deg", "rad") == pytest.approx(math.pi)


@given(st.text(max_size=12))
def test_any_text_is_read_or_refused_with_one_sentence(text):
    try:
        assert isinstance(parse_quantity(text, "s"), float)
    except ValueError as error:
        assert "\n" not in str(error).replace(repr(text), "")


NUMBERS = st.floats(allow_nan=False) | st.integers()


@given(NUMBERS.filter(bool) | st.booleans() | st.none())
def test_a_bare_number_is_refused(value):
    with pytest.raises(ValueError, match="unit"):
        parse_quantity(value, "s")


@pytest.mark.parametrize("text", ["3", "3 kg", "ms", "1e3e3 s", "nan s", "inf s", ""])
def test_wrong_text_is_refused(text):
    with pytest.raises(ValueError):
        parse_quantity(text, "s")


@pytest.mark.parametrize("zero", [0, 0.0, "0", "0.0"])
def test_zero_needs_no_unit(zero):
    assert parse_quantity(zero, "s") == 0.0
