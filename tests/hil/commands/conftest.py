"""A stand-alone bus as a real process."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.standalone_processes import gone, hil, unique


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[tuple[str, int]]:
    """A bus in the background: its name and process."""
    name = unique("lab")
    result = hil("bus", "up", name, "--json", state=tmp_path)
    assert result.returncode == 0, result.stderr
    pid = json.loads(result.stdout)["pid"]
    try:
        yield name, pid
    finally:
        if not gone(pid):
            os.kill(pid, signal.SIGKILL)
