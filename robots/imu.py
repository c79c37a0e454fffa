"""The IMU's sample on its wire: six 16-bit counts, angular velocity then specific force, sensor frame."""

from __future__ import annotations

import struct

import numpy as np

from robots.description import Imu

_SAMPLE = struct.Struct("<6h")
LENGTH = _SAMPLE.size


def encode(gyro: np.ndarray, force: np.ndarray, imu: Imu) -> bytes:
    """12 bytes of angular velocity [rad/s] and specific force [m/s²], quantised and saturated."""
    counts = np.rint(np.concatenate([gyro / imu.gyro_resolution, force / imu.accelerometer_resolution]))
    return np.clip(counts, -32767, 32767).astype("<i2").tobytes()


def decode(payload: bytes, imu: Imu) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity [rad/s] (3,) and specific force [m/s²] (3,). Raises ValueError on a wrong length."""
    if len(payload) != LENGTH:
        raise ValueError(f"an IMU sample has {LENGTH} bytes, not {len(payload)}")
    counts = np.frombuffer(payload, "<i2").astype(float)
    return counts[:3] * imu.gyro_resolution, counts[3:] * imu.accelerometer_resolution
