"""A stock CANopen master on the buses of whole runs: attached from outside, and in lockstep on both backends."""

from __future__ import annotations

import json
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from bus import messages
from bus.frames import Frame
from hil.cli import main
from hil.run import Request, assemble
from hil.scenario import load
from hil.system import Tap
from robots import description

LEFT_LEG, LEFT_KNEE = 1, 6  # bus, node id


class Master(canopen.Network, Tap):
    """A master in lockstep with a system: it sends at the next poll, and simulated time passes until the answer."""

    def __init__(self, system: Any, bus: int) -> None:
        super().__init__()
        self._system, self._on_bus = system, bus
        self._outbox: list[tuple[int, Frame]] = []
        self.log: list[tuple[int, Frame]] = []
        system.tap = self

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._outbox.append((self._on_bus, Frame(can_id, bytes(data), fd=False, brs=False)))
        self.run(3_000_000)

    def run(self, duration_ns: int) -> None:
        self._system.run_until(self._system.now_ns + duration_ns)

    def broadcast(self, bus: int, time_ns: int, sender: int, frame: Frame) -> None:
        if bus == self._on_bus:
            self.log.append((time_ns, frame))
            self.notify(frame.id, bytearray(frame.data), time_ns * 1e-9)

    def poll(self) -> list[tuple[int, Frame]]:
        frames, self._outbox = self._outbox, []
        return frames


@pytest.fixture(scope="module")
def sheets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("eds")
    assert main(["eds", "stand", "--out", str(out)]) == 0
    return out


def sheet(directory: Path, joint: str) -> str:
    return str(directory / f"left_leg_{joint}.eds")


def session(backend: str, sheets: Path) -> list[tuple[int, Frame]]:
    """What a master does while a robot stands: it tunes a gain, provokes a fault and reads of it. Returns the log."""
    with assemble(Request(load("stand"), seed=1, backend=backend)) as assembly:
        system = assembly.system
        system.monitor = None  # a drive in fault would end the run
        master = Master(system, LEFT_LEG)
        knee = master.add_node(LEFT_KNEE, sheet(sheets, "left_knee"))
        system.run_until(400_000_000)
        assert knee.nmt.state == "OPERATIONAL"
        master.scanner.reset()
        master.scanner.search()
        master.run(20_000_000)
        assert sorted(master.scanner.nodes) == [4, 5, 6]
        assert [knee.sdo[0x1018][n].raw for n in range(1, 5)] == [0, 1, 0x10000, LEFT_KNEE]
        assert knee.sdo[0x6041].raw & 0x6F == 0x27  # enabled by the controller
        kp = knee.sdo[0x2000]["kp"]
        kp.raw = 1.25
        assert kp.raw == 1.25
        knee.sdo[0x6072].raw = 900
        saved = system.snapshot()
        knee.sdo[0x6072].raw = 800
        system.restore(saved)
        assert (knee.sdo[0x6072].raw, kp.raw) == (900, 1.25)
        assert knee.sdo[0x6041].raw & 0x6F == 0x27 and not knee.emcy.log  # all the while
        knee.nmt.state = "STOPPED"
        assert [(e.code, e.register) for e in knee.emcy.active] == [(0x8130, 0x11)]
        knee.nmt.state = "PRE-OPERATIONAL"
        assert (knee.sdo[0x1003][0].raw, knee.sdo[0x1003][1].raw, knee.sdo[0x603F].raw) == (1, 0x8130, 0x8130)
        others = {frame.id for time, frame in master.log if time > system.now_ns - 3_000_000}
        assert {messages.COMMAND, messages.STATE + 4, messages.STATE + 5} <= others  # the fast loop goes on
        assert messages.STATE + LEFT_KNEE not in others
        return master.log


def test_a_master_tunes_a_drive_and_reads_its_faults_while_the_loop_runs_alike_on_both_backends(sheets: Path) -> None:
    assert session("inline", sheets) == session("processes", sheets)


def test_every_drive_writes_its_sheet(sheets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = description.load("hume")
    expected = {f"{bus.name}_{joint}.eds" for bus in robot.buses for joint in bus.joints}
    assert {path.name for path in sheets.iterdir()} == expected
    for bus in robot.buses:
        for joint in robot.joints_of(bus):
            od = canopen.import_od(str(sheets / f"{bus.name}_{joint.name}.eds"), joint.node_id)
            assert od[0x1008].default == f"hume {joint.name}"
    assert main(["eds", "stand", "--out", __file__]) == 2
    assert f"--out {__file__}: " in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # python-can's, as the run ends
def test_a_stock_master_joins_a_run_from_outside(tmp_path: Path) -> None:
    out = tmp_path / f"canopen-{uuid.uuid4().hex[:8]}"
    command = [sys.executable, "-m", "hil", "run", "stand", "--duration", "1000", "--json", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    network = canopen.Network()
    try:
        log = out / "left_leg.log"
        for _ in range(1200):
            if log.exists() and log.stat().st_size > 0:
                break
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.05)
        network.connect(interface="hil", channel=f"{out.name}/left_leg")
        network.scanner.reset()
        network.scanner.search()
        knee = network.add_node(LEFT_KNEE, sheet(out, "left_knee"))
        knee.sdo.RESPONSE_TIMEOUT = 10.0  # a machine under load
        for _ in range(2):  # a whole period: the answers to the search have come
            assert knee.nmt.wait_for_heartbeat(30.0) == "OPERATIONAL"
        assert knee.sdo[0x1018][4].raw == LEFT_KNEE and knee.sdo[0x1008].raw == "hume left_knee"
        assert {4, 5, 6} <= set(network.scanner.nodes)
        kp = knee.sdo[0x2000]["kp"]
        kp.raw = 1.25
        assert kp.raw == 1.25
        while knee.sdo[0x6041].raw & 0x6F != 0x27:  # until the controller has enabled it; each read takes its time
            assert process.poll() is None
        with pytest.raises(canopen.SdoAbortedError) as caught:
            knee.sdo[0x6040].raw = 0
        assert caught.value.code == 0x08000022  # the command frame alone commands
        emergencies: list[canopen.emcy.EmcyError] = []
        knee.emcy.add_callback(emergencies.append)
        knee.nmt.state = "STOPPED"
        stdout, stderr = process.communicate(timeout=120)  # a robot without its knee does not stand
        assert process.returncode == 1, stderr
        assert json.loads(stdout)["verdict"] == "unstable"
        network.notifier.stop(5.0)
        assert [(e.code, e.register) for e in emergencies] == [(0x8130, 0x11)]
    finally:
        process.kill()
        process.wait()
        with pytest.raises(can.CanOperationError, match="the emulation has ended"):
            network.disconnect()
    stops = [m for m in can.CanutilsLogReader(log) if m.arbitration_id == 0]
    assert [bytes(m.data) for m in stops] == [bytes([2, LEFT_KNEE])] and not stops[0].is_fd
    lines = [line for line in log.read_text().splitlines() if " 000#" in line or " 606#" in line or " 586#" in line]
    decode = [sys.executable, "-m", "cantools", "decode", "--single-line", str(out / "left_leg.dbc")]
    read = subprocess.run(decode, input="\n".join(lines) + "\n", capture_output=True, text=True, check=True).stdout
    assert "nmt_command: STOP" in read and "left_knee_sdo_response(" in read and "Unknown" not in read
