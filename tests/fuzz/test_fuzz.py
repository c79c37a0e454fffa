"""Property tests over everything that reads foreign bytes: well-formed input, damaged in a few places, or anything."""

import functools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.run import at_random, fuzz
from tests.fuzz.targets import TARGETS


@functools.cache
def seeds(name: str) -> list[bytes]:
    return TARGETS[name].seeds()


@st.composite
def damaged(draw: st.DrawFn, name: str) -> bytes:
    """A seed with flipped bits, replaced bytes, a piece missing or doubled, or cut off; or bytes of no meaning."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=200))
    data = bytearray(draw(st.sampled_from(seeds(name))))
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        kind = draw(st.sampled_from(["flip", "replace", "cut", "double", "end"]))
        if kind == "flip" and data:
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "replace":
            patch = draw(st.one_of(st.binary(min_size=1, max_size=8), st.sampled_from([b"\xff" * 8, b"\0" * 8])))
            data[at : at + len(patch)] = patch
        elif kind == "cut":
            del data[at : at + draw(st.integers(1, 40))]
        elif kind == "double":
            data[at:at] = data[at : at + draw(st.integers(1, 40))]
        else:
            del data[at:]
    return bytes(data)


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_well_formed(name: str) -> None:
    for data in seeds(name):
        TARGETS[name].check(data)


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_is_refused_as_documented(name: str) -> None:
    @settings(max_examples=150, deadline=None)
    @given(damaged(name))
    def check(data: bytes) -> None:
        TARGETS[name].check(data)

    check()


def test_the_coverage_guided_fuzzer_finds_nothing_in_a_second_each(capsys: pytest.CaptureFixture[str]) -> None:
    failed = fuzz(list(TARGETS), seconds=float(len(TARGETS)))
    assert not failed, capsys.readouterr().out


def test_the_fuzzer_finds_a_defect_that_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    """A target that fails on three given bytes, which random input would hardly hit."""
    assert fuzz(["defect"], seconds=20.0) == ["defect"]
    assert "BUG" in capsys.readouterr().out


def test_without_the_fuzzer_seeds_are_mutated_at_random(capsys: pytest.CaptureFixture[str]) -> None:
    seen = set()
    at_random(seen.add, [b"BUG"], 0.05)
    assert b"BUG" in seen and len(seen) > 10 and "Done" in capsys.readouterr().out
    with pytest.raises(ZeroDivisionError):
        at_random(lambda data: 1 // (data[:1] == b"B"), [b"BUG"], 5.0)
    assert "input: b" in capsys.readouterr().out
