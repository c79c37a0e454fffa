"""The CAN frame as nodes exchange it."""

from __future__ import annotations

from typing import NamedTuple

CAN_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


class Frame(NamedTuple):
    """A data frame. ``fd`` frames switch to the data bit rate after arbitration when ``brs`` is set."""

    id: int
    data: bytes
    fd: bool = True
    brs: bool = True
    extended: bool = False
