"""``hil joint`` on ``hil bus``: real processes, a python-can client as the master of the drive."""

import json
import os
import re
import signal
import struct
import subprocess
import threading
from pathlib import Path

import can
import pytest

from bus import messages
from bus.drive_faults import DriveFault
from bus.messages import Controlword, Statusword
from hil.cli import main
from hil.standalone.joint import StandaloneJoint, open_bus
from hil.streams import streams
from joint_firmware.config import FirmwareConfig
from joint_firmware.firmware import JointFirmware
from plant.bench import Bench, Locked
from plant.config import SensorConfig
from robots import description, pins
from tests.support.standalone_processes import PATIENCE_S, Master, hil, start, unique

HUME = description.load("hume")

# A loaded machine may keep both ends from running for longer than a real controller would be silent.
PATIENT = ("--set", "firmware.watchdog=60s")
FRICTIONLESS = ("--set", "world.friction_scale=0")
PERFECT = ("--set", "sensors.noise=0", "--set", "sensors.bias=0")


class joint:
    """``hil joint`` in a process of its own, killed on leaving."""

    def __init__(self, name: str, state: Path, *arguments: str) -> None:
        self.process = start("joint", "--can", f"hil:{name}", *PATIENT, *arguments, "--json", state=state)

    def __enter__(self) -> subprocess.Popen[str]:
        return self.process

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


def test_a_drive_is_walked_through_its_states_and_its_torque_settles_where_it_was_told(
    lab: tuple[str, int], tmp_path: Path
) -> None:
    name, _ = lab
    with (
        can.Bus(interface="hil", channel=name, fd=True) as bus,
        joint(name, tmp_path, "--node", "6", "--load", "locked", *FRICTIONLESS, *PERFECT) as process,
    ):
        master = Master(bus, "left_knee")
        assert master.enable() == [
            Statusword.SWITCH_ON_DISABLED, Statusword.READY_TO_SWITCH_ON, Statusword.SWITCHED_ON,
            Statusword.OPERATION_ENABLED,
        ]  # fmt: skip
        actuator, resolution = master.joint.actuator, abs(master.joint.sensor.torque_resolution)
        for torque in (20.0, -35.0):
            settled = 0
            while settled < 100:  # reports in a row
                state = master.hear()
                settled = settled + 1 if abs(state.torque - torque) <= 2 * resolution else 0
                master.say(Controlword.ENABLE_OPERATION, torque)
            # the physics of the other side: without friction, the motor alone carries what the spring holds
            assert state.current * actuator.torque_per_ampere == pytest.approx(torque, abs=1.0)
            assert state.position == pytest.approx(0.0, abs=2e-4)  # locked
            assert state.error == 0
        process.send_signal(signal.SIGTERM)
        while master.hear().statusword & Statusword.MASK != Statusword.SWITCH_ON_DISABLED:
            master.say(Controlword.ENABLE_OPERATION)  # in vain: it says that it is off, and goes
        stdout, stderr = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, stderr) == (0, "")
        report = json.loads(stdout)
        assert report["joint"] == "left_knee" and report["state"] == "SWITCH_ON_DISABLED"
        assert report["received"] > 200 and report["ignored"] == report["malformed"] == 0
        assert report["wall_clock"]["ticks"] <= report["ticks"] <= report["wall_clock"]["ticks"] + 2

    log = Path(json.loads(hil("bus", "status", name, "--json", state=tmp_path).stdout)["log"])
    assert hil("bus", "down", name, state=tmp_path).returncode == 0
    read = list(can.LogReader(log / "frames.log"))
    states = [messages.decode_state(bytes(m.data)) for m in read if m.arbitration_id == messages.STATE + 6]
    walked = [s.statusword & Statusword.MASK for s in states]
    changes = [state for state, before in zip(walked, [None, *walked], strict=False) if state != before]
    assert changes[-5:] == [0x40, 0x21, 0x23, 0x27, 0x40]  # CiA 402, from "switch on disabled" and back
    assert {m.arbitration_id for m in read} >= {messages.STATE + 6, messages.COMMAND, messages.HEARTBEAT + 6}


def test_a_joint_with_a_fault_from_the_start_says_so_when_it_is_enabled(lab: tuple[str, int], tmp_path: Path) -> None:
    name, _ = lab
    with (
        can.Bus(interface="hil", channel=name, fd=True) as bus,
        joint(name, tmp_path, "--node", "6", "--load", "locked", "--set", "joint.left_knee.supply=0.7"),
    ):
        master = Master(bus, "left_knee")
        words = {Statusword.SWITCH_ON_DISABLED: 0x06, Statusword.READY_TO_SWITCH_ON: 0x07, Statusword.SWITCHED_ON: 0x0F}
        while not (state := master.hear()).error:
            master.say(words.get(state.statusword & Statusword.MASK, 0x0F))
        assert state.error == DriveFault.UNDER_VOLTAGE and state.statusword & Statusword.MASK == Statusword.FAULT


def test_a_pendulum_without_power_swings_until_it_hangs(lab: tuple[str, int], tmp_path: Path) -> None:
    """Started aside and without power, it ends hanging: the plant is a physical one."""
    name, _ = lab
    load = "pendulum,mass=4kg,length=0.5m,damping=3Nms/rad,at=0.8rad"
    with (
        can.Bus(interface="hil", channel=name, fd=True) as bus,
        joint(name, tmp_path, "--joint", "left_hip", "--load", load, *FRICTIONLESS, *PERFECT),
    ):
        master = Master(bus, "left_hip")
        first = master.hear()
        assert 0.0 < first.position <= 0.8001
        still = 0
        while still < 300:
            state = master.hear()
            still = still + 1 if abs(state.position) < 0.02 and abs(state.velocity) < 0.05 else 0


def test_the_bus_killed_ends_the_joint_with_one_sentence_and_status_3(lab: tuple[str, int], tmp_path: Path) -> None:
    name, pid = lab
    with (
        can.Bus(interface="hil", channel=name, fd=True) as bus,
        joint(name, tmp_path, "--node", "6") as process,
    ):
        Master(bus).hear()
        os.kill(pid, signal.SIGKILL)
        stdout, stderr = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, stdout) == (3, "")
        assert re.fullmatch(rf"hil: --can hil:{name}: .*the emulation has ended.*\n", stderr)


def test_it_runs_for_its_duration_at_its_rate_and_reports_its_deadlines(lab: tuple[str, int], tmp_path: Path) -> None:
    name, _ = lab
    result = hil("joint", "--node", "1", "--can", f"hil:{name}", "--rate", "1kHz", "--duration", "0.5s", state=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    assert "right_abduction (node 1)" in result.stdout and "1000 Hz" in result.stdout
    assert re.search(r"ended in SWITCH_ON_DISABLED after 50[0-2] interrupts", result.stdout)
    assert re.search(r"deadlines  [\d.]+ % missed, late by p50", result.stdout)
    told = json.loads(hil("bus", "status", name, "--json", state=tmp_path).stdout)
    assert 225 <= told["identifiers"]["181"]["sent"] <= 251  # it reports at half its rate, once it has booted


def test_it_speaks_on_any_python_can_bus() -> None:
    """python-can's own virtual bus, which is for one process: the joint is a thread of this one."""
    channel = unique("lab")
    config = FirmwareConfig(watchdog="60s")
    bench = Bench(HUME, 5, Locked(), config.rate, SensorConfig(), streams(0))
    with can.Bus(interface="virtual", channel=channel) as bus, open_bus(f"virtual:{channel}") as its_bus:
        node = StandaloneJoint(JointFirmware(HUME, 5, config), bench, its_bus, int(config.rate), 1)
        thread = threading.Thread(target=node.run, args=(None,))
        thread.start()
        try:
            assert Master(bus).enable()[-1] == Statusword.OPERATION_ENABLED
        finally:
            node.stop()
            thread.join(PATIENCE_S)
    assert node.report()["state"] == "SWITCH_ON_DISABLED" and node.bench.pins_out[pins.ENABLE] == 0


def test_what_is_no_command_does_it_no_harm(lab: tuple[str, int], tmp_path: Path) -> None:
    name, _ = lab
    with (
        can.Bus(interface="hil", channel=name, fd=True) as bus,
        joint(name, tmp_path, "--node", "6") as process,
    ):
        master = Master(bus)
        master.hear()
        for data in (b"", b"\xff" * 8, b"\xff" * 64, struct.pack("<64B", *range(64))):
            bus.send(
                can.Message(arbitration_id=messages.COMMAND, is_extended_id=False, is_fd=True, data=data),
                timeout=PATIENCE_S,
            )
        bus.send(can.Message(arbitration_id=messages.COMMAND, is_extended_id=True, is_fd=True, data=b""), timeout=5)
        for _ in range(50):
            master.hear()
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=PATIENCE_S)
        # two of a wrong length, one with a torque of 150 kN m
        assert process.returncode == 0 and json.loads(stdout)["malformed"] == 3


MISTAKES: dict[tuple[str, ...], str] = {
    (): "name the joint, either by --node or by --joint, for example --node 3",
    ("--node", "3", "--joint", "left_knee"): "name the joint, either by --node or by --joint, for example --node 3",
    ("--node", "9"): "--node 9: hume has none; there is 1 (right_abduction), 2 (right_hip), 3 (right_knee), "
    "4 (left_abduction), 5 (left_hip), 6 (left_knee)",
    ("--node", "0"): "argument --node: '0': expected 1 to 127",
    ("--joint", "left_kne"): "--joint left_kne: hume has none; did you mean 'left_knee'?",
    ("--node", "3", "--robot", "hum"):
        "robot = 'hum': no robot 'hum'; there is: hume, valve, vlca, or the path of a TOML file",
    ("--node", "3", "--load", "lockd"): "--load lockd: no load 'lockd'; did you mean 'locked'?",
    ("--node", "3", "--load", "inertia=3"): "--load inertia=3: inertia = '3': '3' has no unit: "
    "write one of kg m², kgm², kg m2, kgm2",
    ("--node", "3", "--load", "inertia,mas=3kg"): "--load inertia,mas=3kg: unknown key 'mas'; valid are inertia, "
    "damping, at",
    ("--node", "3", "--load", "pendulum,3kg"): "--load pendulum,3kg: '3kg' is not KEY=VALUE",
    ("--node", "3", "--load", "locked,at=4rad"): "--load locked,at=4rad: right_knee goes from -0.3491 rad to "
    "3.4907 rad, not to at = 4",
    ("--node", "3", "--load", "inertia=1e-5kgm2"): "--load inertia=1e-5kgm2: inertia of 1e-05 kg m²: expected at least "
    "0.00018 kg m², for the spring of 415 N m/rad at 3000 steps per second",
    ("--node", "3", "--rate", "3000"): "--rate 3000: '3000' has no unit: write one of Hz, kHz, MHz",
    ("--node", "3", "--rate", "0.1Hz"): "--rate 0.1Hz: expected 1 Hz to 1 MHz",
    ("--node", "3", "--rate", "1001Hz"): "firmware.report_rate = 500.5 Hz: expected a whole number of hertz, "
    "at most 1 MHz",
    ("--node", "3", "--duration", "0s"): "--duration 0s: expected more than 0 s",
    ("--node", "3", "--set", "link.command.delay=3ms"): "--set link.command.delay=3ms: a joint alone has firmware.…, "
    "sensors.…, joint.NAME.…, world.friction_scale and world.rate",
    ("--node", "3", "--set", "joint.left_knee.encoder=stuck"): "--set joint.left_knee: the joint here is right_knee",
    ("--node", "3", "--set", "joint.right_knee.command=out_of_range"): "--set joint.right_knee.command: a joint alone "
    "has no controller; send such commands yourself",
    ("--node", "3", "--set", "joint.right_knee.supply=3"): "joint.right_knee.supply = 3: expected at most 2",
    ("--node", "3", "--set", "firmware.watchdg=3ms"): "unknown key 'firmware.watchdg'; "
    "did you mean 'firmware.watchdog'?",
    ("--node", "3", "--can", "lab"): "--can lab: expected INTERFACE:CHANNEL, for example hil:lab or socketcan:can0",
    ("--node", "3", "--can", "nosuch:lab"): '--can nosuch:lab: Unknown interface type "nosuch"',
}  # fmt: skip


@pytest.mark.parametrize("arguments", MISTAKES, ids=" ".join)
def test_a_mistake_is_one_sentence(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["joint", "--can", "hil:no-such-bus", *arguments]) == 2
    out, err = capsys.readouterr()
    sentence = err.removeprefix("hil: ").removesuffix(" (`hil joint --help` lists what there is)\n").rstrip("\n")
    assert (out, sentence) == ("", MISTAKES[arguments])


def test_a_bus_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["joint", "--node", "3", "--can", "hil:no-such-bus"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("hil: --can hil:no-such-bus: no running emulation serves a bus 'no-such-bus'")
    assert err.count("\n") == 1


def test_an_actuator_of_one_s_own_runs_from_the_path_of_its_description(tmp_path: Path) -> None:
    """The worked example of docs/actuators.md."""
    example = Path(__file__).parents[3] / "docs" / "examples" / "geared_motor.toml"
    result = hil(
        "joint", "--robot", str(example), "--joint", "wrist", "--can", "virtual:own", "--duration", "0.1s", "--json",
        state=tmp_path,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["joint"] == "wrist" and report["state"] == "SWITCH_ON_DISABLED"
    assert report["sent"] > 0
