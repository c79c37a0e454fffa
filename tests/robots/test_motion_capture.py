"""The wire format of motion capture's frames."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robots import description, motion_capture
from robots.description import UnknownRobotError
from robots.motion_capture import Frame, MalformedFrameError

SYSTEM = description.load("hume").motion_capture
N = len(SYSTEM.leds)
FRAMES = st.builds(
    Frame,
    st.integers(-(2**63), 2**63 - 1),
    st.integers(0, 2**32 - 1),
    st.lists(st.sampled_from([0.0, 1.0]), min_size=N, max_size=N).map(np.array),
    st.lists(st.lists(st.floats(-1e7, 1e7), min_size=3, max_size=3), min_size=N, max_size=N).map(np.array),
)


@given(FRAMES)
def test_what_is_read_is_what_was_seen_to_half_a_count(frame):
    payload = motion_capture.encode(frame, SYSTEM)
    assert len(payload) == motion_capture.length(SYSTEM)
    read = motion_capture.decode(payload, SYSTEM)
    assert (read.exposure_ns, read.number) == (frame.exposure_ns, frame.number)
    assert (read.seen == frame.seen).all()
    low, high = -(2**31) * SYSTEM.resolution, (2**31 - 1) * SYSTEM.resolution
    expected = np.clip(frame.positions, low, high) * frame.seen[:, None]
    np.testing.assert_allclose(read.positions, expected, rtol=1e-12, atol=SYSTEM.resolution * 0.5000001)
    assert motion_capture.encode(read, SYSTEM) == payload


def test_the_layout_is_the_documented_one():
    positions = np.zeros((N, 3))
    positions[2] = 0.0258, -1e-4, 0.0
    seen = np.zeros(N)
    seen[2] = 1
    payload = motion_capture.encode(Frame(1000, 7, seen, positions), SYSTEM)
    assert payload[:16].hex() == "0109040007000000e803000000000000"
    assert payload[40:52] == struct.pack("<3i", 258, -1, 0) and not any(payload[16:40] + payload[52:])


def changed(offset, value):
    payload = bytearray(motion_capture.encode(Frame(0, 0, np.zeros(N), np.zeros((N, 3))), SYSTEM))
    payload[offset] = value
    return bytes(payload)


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (b"", "124 bytes, not 0"), (changed(0, 1) + b"\0", "124 bytes, not 125"), (changed(0, 2), "version 2, not 1"),
        (changed(1, 8), "8 LEDs"), (changed(3, 2), "0x200"), (changed(20, 1), "not seen"),
    ],
)  # fmt: skip
def test_what_is_no_frame_is_refused(payload, sentence):
    with pytest.raises(MalformedFrameError, match=sentence):
        motion_capture.decode(payload, SYSTEM)


@given(st.binary(min_size=124, max_size=124))
def test_anything_else_is_refused_or_a_frame(payload):
    for candidate in (payload, changed(0, 1)[:4] + payload[4:]):
        try:
            frame = motion_capture.decode(candidate, SYSTEM)
        except MalformedFrameError:
            continue
        assert motion_capture.encode(frame, SYSTEM) == candidate


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ('link = "right_knee"', 'link = "tail"', "LED right_foot: there is no link 'tail'"),
        ('name = "chest"', 'name = "left_foot"', "two LEDs have one name"),
        ("rate = 480", "rate = 0", "motion_capture.rate"),
    ],
)
def test_wrong_leds_are_refused(tmp_path, before, after, sentence):
    from importlib import resources

    text = resources.files("robots").joinpath("hume.toml").read_text(encoding="utf-8")
    assert before in text
    path = tmp_path / "robot.toml"
    path.write_text(text.replace(before, after))
    with pytest.raises(UnknownRobotError, match=sentence):
        description.load(str(path))
