"""python-can's own programs on an emulated bus, started as a user starts them."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import can

_PATIENCE_S = 30.0


def start(tool: str, channel: str, *options: str, **streams: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-u", "-m", f"can.{tool}", "--interface", "hil", "--channel", channel, *options]
    return subprocess.Popen(command, text=True, **streams)  # type: ignore[call-overload]


def test_the_logger_prints_what_is_on_the_bus(lab: str) -> None:
    with start("logger", lab, stdout=subprocess.PIPE) as logger, can.Bus(interface="hil", channel=lab) as bus:
        assert logger.stdout is not None
        line = logger.stdout.readline()
        assert line.startswith("Connected to HilBus: hil lab-")
        while "Can Logger" not in line:
            line = logger.stdout.readline()
        bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\xde\xad"), timeout=_PATIENCE_S)
        line = logger.stdout.readline()
        logger.send_signal(signal.SIGINT)
    assert re.match(r"Timestamp: +\d+\.\d{6} +ID: +123 +S Rx +DL: +2 +de ad +Channel: lab-\d+/can0\n", line), line
    assert logger.returncode == 0


def test_the_player_sends_a_log(lab: str, tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text("(0.000000001) x 123#0102\n(0.000100001) x 1ABCDEF0##5AABB\n(0.000200001) x 7FF#R4\n")
    with can.Bus(interface="hil", channel=lab) as bus:
        with start("player", lab, str(log), stdout=subprocess.DEVNULL) as player:
            received = [bus.recv(_PATIENCE_S) for _ in range(3)]
        assert player.returncode == 0
    assert [(m.arbitration_id, m.data.hex(), m.is_fd, m.is_remote_frame, m.dlc) for m in received if m] == [
        (0x123, "0102", False, False, 2), (0x1ABCDEF0, "aabb", True, False, 2), (0x7FF, "", False, True, 4)
    ]  # fmt: skip


def test_the_viewer_shows_what_is_on_the_bus(lab: str) -> None:
    screen, terminal = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "LINES": "24", "COLUMNS": "120"}
    shown, deadline = "", time.monotonic() + _PATIENCE_S
    with (
        start("viewer", lab, stdin=terminal, stdout=terminal, stderr=terminal, env=environment) as viewer,
        can.Bus(interface="hil", channel=lab) as bus,
    ):
        os.close(terminal)
        task = bus.send_periodic(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\xde\xad"), 0.02)
        while "DE AD" not in shown and time.monotonic() < deadline and viewer.poll() is None:
            if select.select([screen], [], [], 0.1)[0]:
                shown += os.read(screen, 65536).decode(errors="replace")
        task.stop()
        os.write(screen, b"q")
        while viewer.poll() is None and time.monotonic() < deadline:  # it must be able to write until it ends
            if select.select([screen], [], [], 0.1)[0]:
                try:
                    os.read(screen, 65536)
                except OSError:
                    break
        viewer.wait(_PATIENCE_S)
    os.close(screen)
    assert "0x123" in shown and "DE AD" in shown
    assert viewer.returncode == 0
