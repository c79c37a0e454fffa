"""A frame of the motion capture system on its wire: when it was exposed, which LEDs were seen, and where they were.

Little-endian, 16 bytes and 12 for each LED of the robot's description, in its order::

    u8 version  u8 LEDs  u16 seen (bit i: LED i)  u32 number of the frame  i64 exposure (ns)
    i32 x, y, z of each LED, counts of the resolution in the motion capture's frame; 0 for one that was not seen
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from robots.description import MotionCapture

VERSION = 1
_HEADER = struct.Struct("<BBHIq")
_LED_BYTES = 12


class MalformedFrameError(ValueError):
    """Bytes that are no frame of this version and this robot."""


class Frame(NamedTuple):
    """What the cameras saw at one instant."""

    exposure_ns: int
    number: int  # counts exposures, modulo 2³²
    seen: np.ndarray  # (n,) of 0 and 1, float64
    positions: np.ndarray  # (n, 3) m, in the motion capture's frame; 0 where not seen


def length(system: MotionCapture) -> int:
    """Bytes of a frame."""
    return _HEADER.size + _LED_BYTES * len(system.leds)


def encode(frame: Frame, system: MotionCapture) -> bytes:
    """The bytes of ``frame``, its positions quantised and saturated."""
    seen = frame.seen > 0
    mask = sum(1 << i for i in np.flatnonzero(seen).tolist())
    header = _HEADER.pack(VERSION, len(seen), mask, frame.number & 0xFFFFFFFF, frame.exposure_ns)
    counts = np.clip(np.rint(frame.positions / system.resolution), -(2**31), 2**31 - 1) * seen[:, None]
    return header + counts.astype("<i4").tobytes()


def decode(payload: bytes, system: MotionCapture) -> Frame:
    """Read a frame. Raises MalformedFrameError when anything about it is not as it should be."""
    n = len(system.leds)
    if len(payload) != length(system):
        raise MalformedFrameError(f"a frame of {n} LEDs has {length(system)} bytes, not {len(payload)}")
    version, leds, mask, number, exposure_ns = _HEADER.unpack_from(payload)
    if version != VERSION:
        raise MalformedFrameError(f"a frame of version {version}, not {VERSION}")
    if leds != n or mask >> n:
        raise MalformedFrameError(f"{leds} LEDs, seen {mask:#x}: there are {n}")
    seen = np.unpackbits(np.frombuffer(payload, np.uint8, 2, 2), count=n, bitorder="little").astype(float)
    counts = np.frombuffer(payload, "<i4", 3 * n, _HEADER.size).reshape(n, 3)
    if mask + 1 != 1 << n and counts[seen == 0].any():
        raise MalformedFrameError("a position of an LED that was not seen")
    return Frame(exposure_ns, number, seen, counts * system.resolution)
