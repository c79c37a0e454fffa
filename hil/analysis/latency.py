"""Latency of frames on a bus, read from its log."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

_STATE = re.compile(rb"^\((\d{1,9})\.(\d{9})\) \S+ 1[89A-F][0-9A-F]##.([0-9A-F]{4})", re.MULTILINE)


def state_latencies(log: Path, firmware_rate: float, report_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """When each drive state of a bus was delivered, and how long after the joint's sample: both (n,), s.

    A state carries the number of its sample modulo 2**16, and a sample is sent at once: the latency holds
    queueing, arbitration, the frame itself and its repetitions.

    Args:
        log: candump lines of the bus.
        firmware_rate: ticks of a joint per second.
        report_rate: samples per second.
    """
    found = _STATE.findall(log.read_bytes())
    if not found:
        return np.empty(0), np.empty(0)
    seconds, nanoseconds, counters = zip(*found, strict=True)
    delivered = np.array(seconds, dtype="S").astype(np.int64) * 10**9 + np.array(nanoseconds, "S9").astype(
        np.int64
    )
    echoed = np.array([int.from_bytes(bytes.fromhex(c.decode()), "little") for c in counters])
    ratio = round(firmware_rate / report_rate)
    tick = (delivered + 1) * int(firmware_rate) // 10**9  # tick k is at k * 10**9 // rate
    latest = tick // ratio
    sample = latest - ((latest - echoed) & 0xFFFF)
    return delivered * 1e-9, (delivered - sample * ratio * 10**9 // int(firmware_rate)) * 1e-9
