"""The end of processes that are not ours, as an event."""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Iterable


def all_end(pids: Iterable[int], within: float) -> bool:
    """Whether all of the processes end within so many seconds. One that its parent has not looked for has ended."""
    deadline = time.monotonic() + within
    with contextlib.ExitStack() as stack:
        for pid in pids:
            try:
                descriptor = os.pidfd_open(pid)
            except ProcessLookupError:
                continue
            stack.callback(os.close, descriptor)
            readable, *_ = select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))
            if not readable:
                return False
    return True
