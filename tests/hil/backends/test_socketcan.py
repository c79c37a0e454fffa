"""Refusals and bookkeeping of the SocketCAN backend; its runs are tested by `hil socketcan-selftest`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bus import messages
from bus.frames import Frame
from hil.backends import socketcan_tools
from hil.backends.external import ExternalJoint
from hil.backends.socketcan import KernelWire, SocketCan, interface_names
from hil.backends.socketcan_tools import Taps, ToolInterfaces
from hil.cli import main
from hil.errors import UserError
from hil.scenario import load
from robots import description, pins

HUME = description.load("hume")


def test_names_of_interfaces() -> None:
    buses, joints = interface_names(HUME, "socketcan")
    assert buses == ["right_leg", "left_leg"]
    assert joints == [f"right_leg.{n}" for n in (1, 2, 3)] + [f"left_leg.{n}" for n in (4, 5, 6)]
    assert all(len(name) <= 15 for name in joints)
    _, joints = interface_names(HUME, "socketcan-plain")
    assert joints == ["right_leg"] * 3 + ["left_leg"] * 3


@pytest.mark.parametrize("setting", ["bus.left_leg.loss=0.01", "bus.right_leg.delay=1ms"])
def test_a_plain_bus_refuses_faults(setting: str) -> None:
    with pytest.raises(UserError, match="no impairments, use --can socketcan"):
        SocketCan(HUME, load("stand", [setting]), "socketcan-plain")
    SocketCan(HUME, load("stand", [setting]), "socketcan")
    SocketCan(HUME, load("stand", ["link.command.delay=1ms"]), "socketcan-plain")


def test_inline_has_no_socketcan(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert main(["run", "stand", "--backend", "inline", "--can", "socketcan", "--out", str(out)]) == 2
    assert "--can socketcan has no meaning with --backend inline" in capsys.readouterr().err
    assert not out.exists()


def test_a_kernel_without_can_is_refused_before_anything_is_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("bus.socketcan.supported", lambda: False)
    assert main(["run", "stand", "--can", "socketcan", "--out", str(tmp_path / "run")]) == 2
    assert "this kernel has no CAN sockets" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--interface", "left_leg.6=can0"], "--interface needs --can socketcan"),
        (["--external", "3"], "--external needs --can socketcan and --clock wall"),
        (["--external", "3", "--can", "socketcan"], "--external needs --can socketcan and --clock wall"),
        (["--external", "3", "--can", "socketcan-plain", "--clock", "wall"], "--external needs --can socketcan and"),
        (["--can", "socketcan", "--interface", "can0"], "--interface can0: expected NAME=CAN"),
    ],
)
def test_options_that_do_not_go_together(
    capsys: pytest.CaptureFixture[str], arguments: list[str], complaint: str
) -> None:
    assert main(["run", "stand", *arguments]) == 2
    assert complaint in capsys.readouterr().err


def test_external_joints_and_interfaces_by_name() -> None:
    scenario = load("stand", [])
    with pytest.raises(UserError, match=r"--external 9: no joint has this node id; there are 1 \(right_abduction\), 2"):
        SocketCan(HUME, scenario, "socketcan", external=[9])
    with pytest.raises(UserError, match=r"there is no left_knee, only right_leg, left_leg, right_leg.1, "):
        SocketCan(HUME, scenario, "socketcan", renamed={"left_knee": "can0"})
    with pytest.raises(UserError, match="cannot take the place of two"):
        SocketCan(HUME, scenario, "socketcan", renamed={"left_leg.6": "can0", "left_leg.5": "can0"})
    SocketCan(HUME, scenario, "socketcan", [3, 6], {"right_leg.3": "can0", "left_leg.6": "can1"})


def test_an_external_joint_drives_the_plant_with_the_current_it_reports() -> None:
    joint = ExternalJoint(HUME.joints[2])
    outputs = np.zeros(pins.N_OUTPUTS, np.int32)
    joint.attach(np.zeros(pins.N_INPUTS, np.int32), outputs)
    state = messages.State(0, messages.Statusword.OPERATION_ENABLED, 0.1, 0.0, 5.0, -2.5, 0.0, 0, 0, 30)
    report = Frame(messages.STATE + 3, messages.encode_state(state))
    assert joint.tick(0, [Frame(messages.COMMAND, bytes(64)), report]) == []
    assert outputs.tolist() == [-250, 1]
    other = Frame(messages.STATE + 2, messages.encode_state(state._replace(current=9.0)))
    joint.tick(1, [other, Frame(messages.STATE + 3, b"short")])
    assert outputs.tolist() == [-250, 1] and joint.malformed == 1
    off = messages.encode_state(state._replace(statusword=messages.Statusword.FAULT))
    joint.tick(2, [Frame(messages.STATE + 3, off)])
    assert outputs.tolist() == [0, 0]


class FakeEnd:
    """A port whose other side is the test."""

    def __init__(self, channel: str = "") -> None:
        self.sent: list[Frame] = []
        self.incoming: list[Frame] = []

    def send_frame(self, frame: Frame) -> None:
        self.sent.append(frame)

    def waiting(self) -> tuple[int, list[Frame]]:
        frames, self.incoming = self.incoming, []
        return len(frames), frames

    def shutdown(self) -> None:
        pass


def test_a_plain_wire_sends_what_is_offered_and_attributes_what_arrives() -> None:
    end = FakeEnd()
    wire = KernelWire("left_leg", end, [4, 5, 6])  # type: ignore[arg-type]
    command, state = Frame(messages.COMMAND, bytes(64)), Frame(messages.STATE + 5, bytes(24))
    stranger = Frame(0x123, b"")
    wire.offer(1000, 0, command)
    assert end.sent == [command] and wire.given == 1
    wire.arrived(1000, state)
    wire.arrived(1000, stranger)
    assert end.sent == [command]  # what has arrived is on the bus already
    assert wire.next_ns == 1000
    assert [(d.time, d.sender, d.frame) for d in wire.advance(1000)] == [
        (1000, 0, command), (1000, 2, state), (1000, wire.ports - 1, stranger)
    ]  # fmt: skip
    assert wire.next_ns > 1000 and wire.sent == 3
    with pytest.raises(UserError, match="no impairments"):
        wire.set("loss", 0.1)


def test_a_tools_frame_is_not_shown_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    ends: list[Any] = []

    def make(channel: str) -> FakeEnd:
        ends.append(FakeEnd(channel))
        return ends[-1]

    monkeypatch.setattr(socketcan_tools, "SocketCanPort", make)
    taps = Taps([ToolInterfaces(["left_leg"])])
    own, other = Frame(0x601, bytes(8), False, False), Frame(0x184, bytes(24))
    ends[0].incoming = [own]
    assert taps.poll() == [(0, own)]
    taps.broadcast(0, 0, 1, other)
    taps.broadcast(0, 1, 4, own)
    assert ends[0].sent == [other]
    taps.broadcast(0, 2, 4, own)  # the same content again is from somebody else
    assert ends[0].sent == [other, own]


def test_a_refused_frame_is_told_to_the_tap_that_it_is_from(monkeypatch: pytest.MonkeyPatch) -> None:
    ends: list[Any] = []
    monkeypatch.setattr(socketcan_tools, "SocketCanPort", lambda channel: ends.append(FakeEnd(channel)) or ends[-1])
    first, second = ToolInterfaces(["left_leg"]), ToolInterfaces(["left_leg"])
    taps = Taps([first, second])
    frame = Frame(0x601, bytes(8), False, False)
    ends[1].incoming = [frame]
    assert taps.poll() == [(0, frame)]
    taps.refused(0, frame)
    taps.broadcast(0, 0, 1, frame)  # of another node, now
    assert ends[0].sent == [frame] and ends[1].sent == [frame]
