"""The IMU's sample on its wire: six 16-bit counts, angular velocity then specific force, sensor frame."""

from __future__ import annotations

import numpy as np

from robots.description import Imu

LENGTH = 12
_LIMIT = 32767


def resolutions(imu: Imu) -> np.ndarray:
    """What a count is worth (6,): three times [rad/s], three times [m/s²]."""
    return np.repeat([imu.gyro_resolution, imu.accelerometer_resolution], 3)


def pack(sample: np.ndarray, resolution: np.ndarray) -> bytes:
    """12 bytes of a ``sample`` (6,), angular velocity [rad/s] and specific force [m/s²], quantised by ``resolution``,
    and saturated."""
    counts = np.rint(sample / resolution)
    return np.minimum(np.maximum(counts, -_LIMIT), _LIMIT).astype("<i2").tobytes()


def unpack(payload: bytes, resolution: np.ndarray) -> np.ndarray:
    """The sample (6,) that ``pack`` made bytes of. Raises ValueError on a wrong length."""
    if len(payload) != LENGTH:
        raise ValueError(f"an IMU sample has {LENGTH} bytes, not {len(payload)}")
    return np.frombuffer(payload, "<i2") * resolution


def encode(gyro: np.ndarray, force: np.ndarray, imu: Imu) -> bytes:
    """12 bytes of angular velocity [rad/s] and specific force [m/s²], quantised and saturated."""
    return pack(np.concatenate([gyro, force]), resolutions(imu))


def decode(payload: bytes, imu: Imu) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity [rad/s] (3,) and specific force [m/s²] (3,). Raises ValueError on a wrong length."""
    sample = unpack(payload, resolutions(imu))
    return sample[:3], sample[3:]
