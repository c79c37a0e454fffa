"""The IMU's wire format."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robots import description, imu

IMU = description.load("hume").imu
COUNTS = st.lists(st.integers(-32767, 32767), min_size=6, max_size=6)
VALUES = st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3)


@given(COUNTS)
def test_counts_survive_the_round_trip(counts):
    payload = np.array(counts, "<i2").tobytes()
    assert imu.encode(*imu.decode(payload, IMU), IMU) == payload


@given(VALUES, VALUES)
def test_error_is_half_a_count_or_saturation(gyro, force):
    payload = imu.encode(np.array(gyro), np.array(force), IMU)
    assert len(payload) == 12
    resolutions = IMU.gyro_resolution, IMU.accelerometer_resolution
    for given_, read, resolution in zip((gyro, force), imu.decode(payload, IMU), resolutions, strict=True):
        limit = 32767 * resolution
        np.testing.assert_allclose(read, np.clip(given_, -limit, limit), rtol=0, atol=resolution * 0.5000001)


def test_first_count_is_the_gyro_x_low_byte_first():
    payload = imu.encode(np.array([IMU.gyro_resolution * 258, 0, 0]), np.zeros(3), IMU)
    assert payload == bytes([2, 1]) + bytes(10)


def test_wrong_length_is_refused():
    with pytest.raises(ValueError, match="12 bytes"):
        imu.decode(bytes(11), IMU)
