"""Faults of single clients of a stand-alone bus: real processes, with python-can as the clients."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from bus.ports import connect
from hil.cli import main
from tests.support.standalone_processes import (
    PATIENCE_S,
    attach,
    gone,
    hil,
    message,
    receive,
    status,
    unique,
    wait_for,
)

ERR_ACK, ERR_BUSOFF, ERR_BUSERROR, ERR_RESTARTED = 0x20, 0x40, 0x80, 0x100  # linux/can/error.h
UNACKNOWLEDGED = (128, 0)  # where TEC stops rising: an error passive node does not count a missing acknowledgement


class Lab:
    """A bus that is up."""

    def __init__(self, state: Path, *settings: str) -> None:
        self.name, self.state = unique("lab"), state
        set_ = [part for setting in settings for part in ("--set", f"bus.{self.name}.{setting}")]
        result = hil("bus", "up", self.name, *set_, state=state)
        assert result.returncode == 0, result.stderr
        self.pid = self.status()["pid"]

    def attach(self) -> can.BusABC:
        return attach(self.name)

    def status(self) -> dict[str, Any]:
        return status(self.name, self.state)

    def client(self, bus: can.BusABC) -> dict[str, Any]:
        """What the bus tells of a client."""
        (one,) = [client for client in self.status()["clients"] if client["node"] == node(bus)]
        return one

    def inject(self, bus: can.BusABC | str, fault: str, value: str = "true") -> None:
        name = bus if isinstance(bus, str) else node(bus)
        result = hil("inject", f"bus.{self.name}.node.{name}.{fault}", value, state=self.state)
        assert (result.returncode, result.stderr) == (0, "")

    def events(self) -> str:
        return (self.state / "hume-hil" / "bus" / self.name / "events.log").read_text()


@pytest.fixture
def up(tmp_path: Path) -> Iterator[Callable[..., Lab]]:
    labs = []

    def start(*settings: str) -> Lab:
        labs.append(Lab(tmp_path, *settings))
        return labs[-1]

    yield start
    for lab in labs:
        if not gone(lab.pid):
            os.kill(lab.pid, signal.SIGKILL)


def node(bus: can.BusABC) -> str:
    """What a client is called on its bus."""
    match = re.search(r"\((port\d+)\)$", bus.channel_info)
    assert match is not None, bus.channel_info
    return match.group(1)


def first(bus: can.BusABC, wanted: Callable[[can.Message], Any]) -> can.Message:
    """The next message that is ``wanted``."""
    deadline = time.monotonic() + PATIENCE_S
    while not wanted(received := receive(bus)):
        assert time.monotonic() < deadline, "it did not come"
    return received


def frame(bus: can.BusABC) -> can.Message:
    """The next one that is no error frame."""
    return first(bus, lambda received: not received.is_error_frame)


def error(bus: can.BusABC, classes: int) -> can.Message:
    """The next error frame of one of these classes."""
    return first(bus, lambda received: received.is_error_frame and received.arbitration_id & classes)


def counters(client: dict[str, Any]) -> tuple[int, int]:
    return client["tec"], client["rec"]


def test_status_shows_by_which_name_a_client_is_found(up: Callable[..., Lab]) -> None:
    lab = up()
    with lab.attach() as one, lab.attach() as other:
        lab.inject(other, "bit_rate", "1.01")
        lab.inject(other, "cut")
        lines = hil("bus", "status", lab.name, state=lab.state).stdout.splitlines()
        (first, second) = [line for line in lines if line.startswith("client ")]
        assert first.startswith(f"client    {node(one)}, ") and f"({os.getpid()}): 0 sent" in first
        assert first.endswith("; error active, TEC 0, REC 0")
        assert second.startswith(f"client    {node(other)}, ")
        assert second.endswith("; error active, TEC 0, REC 0; bit_rate = 1.01; cut = true")
        lab.inject(other, "cut", "false")
        assert lab.client(other)["faults"] == {"bit_rate": 1.01}


def test_who_asks_takes_no_place_on_the_bus(up: Callable[..., Lab]) -> None:
    """Ports are given in turn: one that was taken meanwhile would not come next."""
    lab = up()
    with lab.attach() as one:
        for _ in range(2):
            hil("bus", "list", state=lab.state)
            lab.status()
        with lab.attach() as other:
            assert (node(one), node(other)) == ("port0", "port1")


def test_a_cut_client_neither_sends_nor_receives_and_its_counters_stand_still(up: Callable[..., Lab]) -> None:
    lab = up()
    with lab.attach() as client, lab.attach() as sender, lab.attach() as listener:
        lab.inject(client, "cut")
        waits = client.transmit(message(0x10))
        sender.send(message(0x20))
        assert frame(listener).arbitration_id == 0x20  # though 0x10 would win
        with pytest.raises(can.CanOperationError, match="not on the bus within a second"):
            waits.result(PATIENCE_S)
        assert counters(lab.client(client)) == (0, 0)
        lab.inject(client, "cut", "false")
        assert frame(listener).arbitration_id == 0x10  # as from a controller that has waited for its cable
        sender.send(message(0x21))
        assert frame(client).arbitration_id == 0x21  # not 0x20
    told = lab.status()["injected"]
    assert [(one["key"].rpartition(".")[2], one["value"], one["pid"]) for one in told] == [
        ("cut", "true", os.getpid()), ("cut", "false", os.getpid())
    ]  # fmt: skip
    assert re.search(rf"\) injected bus\.{lab.name}\.node\.port\d\.cut = true \(.+, {os.getpid()}\)\n", lab.events())


def test_who_has_waited_for_the_cable_loses_nothing(up: Callable[..., Lab]) -> None:
    """More than the controller holds, for longer than the program is told after."""
    lab = up()
    count = 60
    with lab.attach() as client, lab.attach() as listener:
        lab.inject(client, "cut")
        waiting = [client.transmit(message(0x10, bytes([n]))) for n in range(count)]
        with pytest.raises(can.CanOperationError):
            waiting[0].result(PATIENCE_S)
        lab.inject(client, "cut", "false")
        assert [frame(listener).data[0] for _ in range(count)] == list(range(count))
        assert waiting[-1].result(PATIENCE_S) > 1.0


@pytest.mark.parametrize("fault", ["cut", "listen_only"])
def test_without_anybody_who_acknowledges_a_sender_goes_on_trying(fault: str, up: Callable[..., Lab]) -> None:
    """ISO 11898-1: eight more for each missing acknowledgement, and not beyond error passive. Who asks for the status
    meanwhile does not acknowledge, and is answered, though the bus is computed more slowly than it runs."""
    lab = up("node.others.cut=true")
    with lab.attach() as client, lab.attach() as sender:
        lab.inject(client, fault)
        sent = sender.transmit(message(0x20))
        assert error(sender, ERR_ACK).data[6] == 8
        wait_for(lambda: counters(lab.client(sender)) == UNACKNOWLEDGED, "error passive")
        told = lab.status()
        assert (told["sent"], told["lost"]) == (0, 0) and told["identifiers"]["020"]["retransmitted"] >= 16
        assert counters(lab.client(client)) == (0, 0)  # a listener counts nothing either
        assert sender.state is can.BusState.PASSIVE
        lab.inject(client, fault, "false")
        assert frame(client).arbitration_id == 0x20
        assert sent.done() or wait_for(lambda: lab.status()["sent"] == 1, "the frame")


def test_one_who_only_listens_hears_and_sends_nothing(up: Callable[..., Lab]) -> None:
    lab = up()
    with lab.attach() as client, lab.attach() as other:
        lab.inject(client, "listen_only")
        client.send(message(0x10))
        other.send(message(0x20))
        assert frame(client).arbitration_id == 0x20
        lab.inject(client, "listen_only", "false")
        assert frame(other).arbitration_id == 0x10


def test_the_others_can_be_taken_away_and_come_back(up: Callable[..., Lab]) -> None:
    lab = up()
    with lab.attach() as alone:
        alone.transmit(message(0x10)).result(PATIENCE_S)  # they acknowledge
        lab.inject("others", "cut")
        sent = alone.transmit(message(0x11))
        error(alone, ERR_ACK)
        lab.inject("others", "cut", "false")
        sent.result(PATIENCE_S)
        lab.inject("others", "cut")
        result = hil("inject", f"bus.{lab.name}.babble.rate", "100Hz", state=lab.state)
        assert result.returncode == 0, result.stderr
        alone.transmit(message(0x12)).result(PATIENCE_S)  # who babbles is there
        assert frame(alone).arbitration_id == 0x001


def test_nobody_can_send_while_one_holds_the_bus_dominant(up: Callable[..., Lab]) -> None:
    lab = up()
    with lab.attach() as client, lab.attach() as sender, lab.attach() as listener:
        lab.inject(client, "stuck_dominant")
        waits = sender.transmit(message(0x20))
        with pytest.raises(can.CanOperationError, match="not on the bus within a second"):
            waits.result(PATIENCE_S)
        told = lab.status()
        assert told["sent"] == 0
        assert {one["state"] for one in told["clients"]} == {"error passive"}
        lab.inject(client, "stuck_dominant", "false")
        assert frame(listener).arbitration_id == 0x20
        for n in range(33):  # every frame received takes one off, from 127 to below 96
            for one, other in ((sender, listener), (listener, sender)):
                one.send(message(0x30, bytes([n])))
                assert frame(other).data[0] == n
        assert {one["state"] for one in lab.status()["clients"]} == {"error active"}


@pytest.mark.parametrize("one_shot", [False, True])
def test_who_sends_in_one_shot_gives_a_frame_up_that_fails(one_shot: bool, up: Callable[..., Lab]) -> None:
    lab = up("damage=0x020 crc:3")
    with lab.attach() as client, lab.attach() as listener:
        if one_shot:
            lab.inject(client, "one_shot")
        first, second = (client.transmit(message(identifier)) for identifier in (0x20, 0x30))
        heard = [frame(listener).arbitration_id for _ in range(1 if one_shot else 2)]
        second.result(PATIENCE_S)
        counts = lab.status()["identifiers"]["020"]
        if one_shot:
            assert heard == [0x30]
            with pytest.raises(can.CanOperationError, match="it is lost"):
                first.result(PATIENCE_S)
            assert (counts["sent"], counts["lost"], counts["retransmitted"]) == (0, 1, 0)
        else:
            assert heard == [0x20, 0x30] or heard == [0x30, 0x20]
            first.result(PATIENCE_S)
            assert (counts["sent"], counts["lost"], counts["retransmitted"]) == (1, 0, 1)


def test_with_a_wrong_bit_rate_nobody_understands_it(up: Callable[..., Lab]) -> None:
    lab = up()
    with lab.attach() as client, lab.attach() as listener:
        lab.inject(client, "bit_rate", "1.1")
        client.send(message(0x20))
        error(client, ERR_BUSERROR)
        error(listener, ERR_BUSERROR)
        wait_for(lambda: counters(lab.client(listener))[1] >= 128, "error passive")
        told = lab.status()
        assert told["sent"] == 0 and told["errors"] >= 16
        assert lab.client(client)["faults"] == {"bit_rate": 1.1}
        lab.inject(client, "bit_rate", "1")
        wait_for(lambda: lab.status()["sent"] == 1, "the frame")
        while listener.recv(0) is not None:  # more error frames than it could take
            pass
        client.send(message(0x21))
        assert frame(listener).arbitration_id == 0x21
        assert lab.client(client)["faults"] == {}


def test_who_is_bus_off_comes_back_when_it_is_asked_to(up: Callable[..., Lab]) -> None:
    """Without automatic recovery nothing else brings it back."""
    lab = up("bus_off_recovery=request", "bit_error_rate=0.05")
    with lab.attach() as client, lab.attach() as other, lab.attach() as listener:
        client.send(message(0x20))
        error(client, ERR_BUSOFF)
        assert lab.client(client)["state"] == "bus off"
        assert client.state is can.BusState.ERROR
        result = hil("inject", f"bus.{lab.name}.bit_error_rate", "0", state=lab.state)
        assert result.returncode == 0, result.stderr
        for n in range(200):  # more than 128 times 11 recessive bits
            other.send(message(0x100, bytes([n])))
            assert frame(listener).data[0] == n
        assert lab.client(client)["state"] == "bus off"
        lab.inject(client, "restart")
        assert frame(listener).arbitration_id == 0x20
        error(client, ERR_RESTARTED)
        told = lab.client(client)
        assert (told["state"], counters(told), told["faults"]) == ("error active", (0, 0), {})
        assert client.state is can.BusState.ACTIVE


def test_a_fault_goes_with_its_client_and_the_next_at_its_port_is_sound(up: Callable[..., Lab]) -> None:
    """With all ports but one taken, the next client gets the one that becomes free."""
    lab = up()
    sockets: list[socket.socket] = []
    with lab.attach() as listener:
        client = lab.attach()
        sockets += [connect(lab.name)[0] for _ in range(30)]
        name = node(client)
        for fault, value in (("cut", "true"), ("listen_only", "true"), ("one_shot", "true"), ("bit_rate", "1.1")):
            lab.inject(client, fault, value)
        for n in range(40):  # more than its controller holds
            client.send(message(0x10, bytes([n])))
        client.shutdown()
        wait_for(lambda: len(lab.status()["clients"]) == 31, "its going")
        with lab.attach() as following:
            assert node(following) == name
            told = lab.client(following)
            assert (told["faults"], told["state"], counters(told)) == ({}, "error active", (0, 0))
            following.transmit(message(0x20)).result(PATIENCE_S)
            assert frame(listener).arbitration_id == 0x20  # nothing of what the one before had left
            listener.send(message(0x30))
            assert frame(following).arbitration_id == 0x30
            assert lab.status()["errors"] == 0
    for one in sockets:
        one.close()
    assert f") {name} has left, and with it cut, listen_only, one_shot, bit_rate\n" in lab.events()


def test_a_stuck_client_lets_go_when_it_is_killed(up: Callable[..., Lab]) -> None:
    lab = up()
    stuck, _ = connect(lab.name)
    with lab.attach() as sender, lab.attach() as listener:
        lab.inject("port0", "stuck_dominant")
        sender.send(message(0x20))
        assert lab.status()["sent"] == 0
        stuck.close()
        assert frame(listener).arbitration_id == 0x20


def test_the_keys_of_the_clients_that_are_there_are_listed(
    up: Callable[..., Lab], capsys: pytest.CaptureFixture[str]
) -> None:
    lab = up()
    path = f"bus.{lab.name}"
    with lab.attach(), lab.attach():
        assert main(["inject", "--list", path]) == 0
        lines = capsys.readouterr().out.splitlines()
        of_port1 = [line for line in lines if line.startswith(f"{path}.node.port1.")]
        assert [line.split()[0].rpartition(".")[2] for line in of_port1] == [
            "cut", "stuck_dominant", "listen_only", "one_shot", "restart", "bit_rate"
        ]  # fmt: skip
        assert re.search(r"bit_rate +0\.5 to 2 +1\.0 +its bit rates over the bus's$", of_port1[-1])
        nodes = {match.group(1) for line in lines if (match := re.match(rf"{re.escape(path)}\.node\.(\w+)\.", line))}
        assert nodes == {"port0", "port1", "others"}
        assert any(line.startswith(f"{path}.delay ") for line in lines)
        assert main(["inject", "--list", f"{path}.node.port1"]) == 0
        assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == [
            line.split()[0] for line in of_port1
        ]


def test_a_mistake_is_answered_with_what_there_is(up: Callable[..., Lab], capsys: pytest.CaptureFixture[str]) -> None:
    lab = up()
    path = f"bus.{lab.name}.node"

    def refused(*arguments: str) -> str:
        assert main(["inject", *arguments]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1
        return err.removeprefix("hil: ").rstrip("\n")

    nobody = f"{path}.port0.cut: no client 'port0'; none is attached"
    assert refused(f"{path}.port0.cut", "true") == nobody
    with lab.attach(), lab.attach():
        there = rf"attached: port0 \(.+, {os.getpid()}\), port1 \(.+, {os.getpid()}\)"
        for name in ("port7", "left_knee", "port", "0"):
            expected = rf"{re.escape(path)}\.{name}\.cut: no client '{name}'; {there}"
            assert re.fullmatch(expected, refused(f"{path}.{name}.cut", "true"))
        nobody = rf"{re.escape(path)}\.port7: no client 'port7'; {there}"
        assert re.fullmatch(nobody, refused("--list", f"{path}.port7"))
        for key, value, part in (
            ("port0.drift", "50ppm", "drift is a fault of the joints of a run; a client's clock and node id are its"),
            ("port0.node_id", "4", "node_id is a fault of the joints of a run"),
            ("port0.ct", "true", f"did you mean '{path}.port0.cut'?"),
            ("port0", "true", "expected a table with cut, "),
            ("port0.cut.deep", "true", "expected"),
            ("port0.bit_rate", "3", "expected at most 2"),
            ("port0.bit_rate", "fast", "expected a finite number"),
            ("port0.cut", "perhaps", "expected true or false"),
            ("others.bit_rate", "1.1", f"the nodes that are no clients can only be cut ({path}.others.cut)"),
        ):
            assert part in (said := refused(f"{path}.{key}", value)), said
    assert lab.status()["injected"] == []


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("node.port3.cut=true", "--set bus.lab.node.port3.cut=true: no client 'port3'; none is attached"),
        ("node.others.cut=maybe", "bus.lab.node.others.cut = 'maybe': expected true or false"),
        ("bus_off_recovery=never", "bus.lab.bus_off_recovery = 'never': expected 'automatic' or 'request'"),
    ],
)
def test_what_cannot_be_set_from_the_start(setting: str, sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bus", "up", "lab", "--no-log", "--set", f"bus.lab.{setting}"]) == 2
    assert capsys.readouterr().err == f"hil: {sentence}\n"
