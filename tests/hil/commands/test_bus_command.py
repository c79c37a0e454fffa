"""``hil bus``: real processes from ``up`` to ``down``, with python-can as the client."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import can
import pytest

from bus.config import BusConfig
from bus.frames import Frame
from bus.port_client import peer
from bus.ports import PortError, connect, served
from bus.records import pack_frame
from bus.timing import frame_ns
from hil.cli import main
from hil.standalone.control import buses
from hil.standalone.server import StandaloneBus
from tests.support.standalone_processes import (
    PATIENCE_S,
    attach,
    gone,
    hil,
    message,
    receive,
    start,
    status,
    unique,
    wait_for,
)

RATES = {"arbitration_rate": 1e6, "data_rate": 5e6}


def test_up_detaches_says_how_to_attach_and_down_leaves_nothing(tmp_path: Path) -> None:
    name = unique("lab")
    result = hil("bus", "up", name, "--fd", "500k/2M", state=tmp_path)  # returns: nothing holds its output open
    assert (result.returncode, result.stderr) == (0, "")
    pid = int(re.search(r"process (\d+)", result.stdout).group(1))  # type: ignore[union-attr]
    assert "CAN FD 0.5 Mbit/s and 2 Mbit/s" in result.stdout
    assert f'can.Bus(interface="hil", channel="{name}")' in result.stdout
    assert f"hil bus down {name}" in result.stdout
    log = tmp_path / "hume-hil" / "bus" / name
    assert f"log      {log}\n" in result.stdout

    # a session of its own, no terminal, no descriptor of ours but its own logs
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    assert int(fields[3]) != os.getsid(0) and int(fields[3]) != pid and fields[4] == "0"
    files = [os.readlink(f"/proc/{pid}/fd/{n}") for n in range(3)]
    assert files == [os.devnull, f"{log}/messages.txt", f"{log}/messages.txt"]
    assert os.readlink(f"/proc/{pid}/cwd") == "/"

    assert name in hil("bus", "list", state=tmp_path).stdout
    result = hil("bus", "down", name, state=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    assert gone(pid)
    assert (name, name) not in served()
    assert name not in hil("bus", "list", state=tmp_path).stdout
    assert hil("bus", "down", name, state=tmp_path).returncode == 2
    assert (log / "messages.txt").read_text() == ""
    events = (log / "events.log").read_text()
    assert "up: CAN FD" in events and events.endswith("down: SIGTERM\n")


def test_a_descriptor_of_the_caller_is_not_kept(tmp_path: Path) -> None:
    """A script's lock or pipe must not outlive the script in the background process."""
    name = unique("lab")
    read, write = os.pipe()
    subprocess.run(
        [sys.executable, "-m", "hil", "bus", "up", name, "--no-log"], pass_fds=[write], check=True,
        stdout=subprocess.DEVNULL, timeout=PATIENCE_S,
    )  # fmt: skip
    os.close(write)
    try:
        assert os.read(read, 1) == b""  # end of file: nobody else has it
    finally:
        os.close(read)
        assert hil("bus", "down", name, state=tmp_path).returncode == 0


def test_a_second_bus_of_the_same_name_is_refused_and_the_first_goes_on(lab: tuple[str, int], tmp_path: Path) -> None:
    name, pid = lab
    for how in ((), ("--foreground",)):
        result = hil("bus", "up", name, *how, state=tmp_path)
        assert (result.returncode, result.stdout) == (2, "")
        assert result.stderr == f"hil: a bus {name!r} is up already (`hil bus down {name}` ends it)\n"
    assert status(name, tmp_path)["pid"] == pid


def test_frames_take_their_time_and_clients_their_turn(lab: tuple[str, int], tmp_path: Path) -> None:
    """Two clients send at once: while one frame is on the wire, the others line up by identifier."""
    name, _ = lab
    count, rounds = 20, 0
    with attach(name) as low, attach(name) as high, attach(name) as listener:
        while True:
            rounds += 1
            for n in range(count):  # more than what is on the wire by the time the others start
                low.send(message(0x700, bytes([n]) * 64))
                high.send(message(0x100, bytes([n]) * 64))
            heard = [receive(listener) for _ in range(2 * count)]
            own = [receive(high) for _ in range(count)]  # of the other only
            assert [m.arbitration_id for m in own] == [0x700] * count
            for identifier in (0x100, 0x700):  # each in its own order
                assert [m.data[0] for m in heard if m.arbitration_id == identifier] == list(range(count))
            for before, after in itertools.pairwise(heard):
                frame = Frame(after.arbitration_id, bytes(after.data))
                least = (frame_ns(frame, **RATES) - 3000) * 1e-9  # its own intermission comes after it
                assert after.timestamp - before.timestamp >= least + 3e-6 - 2e-9  # the one of the frame before it
            told = status(name, tmp_path)
            sent = rounds * count
            assert told["sent"] == 2 * sent and told["lost"] == told["errors"] == 0
            assert {i: c["sent"] for i, c in told["identifiers"].items()} == {"100": sent, "700": sent}
            waited = {i: c["wait_max_us"] for i, c in told["identifiers"].items()}
            if waited["700"] > waited["100"]:
                break
            # Clients that get the processor too rarely leave no frames to line up; never so in ten rounds.
            assert rounds < 10, waited
    assert told["lateness"]["events"] == 2 * sent and told["lateness"]["max_us"] > 0


def test_a_client_that_floods_waits_itself_and_loses_nothing(lab: tuple[str, int], tmp_path: Path) -> None:
    name, _ = lab
    count = 2000
    with attach(name) as sender, attach(name) as receiver:
        heard: list[int] = []

        def listen() -> None:
            while len(heard) < count:
                heard.append(int.from_bytes(receive(receiver).data[:4], "little"))

        thread = threading.Thread(target=listen)
        thread.start()
        for n in range(count):
            sender.send(message(0x123, n.to_bytes(4, "little")))
        thread.join(PATIENCE_S)
        told = status(name, tmp_path)  # with both attached
    assert heard == list(range(count))
    mine = [c for c in told["clients"] if c["pid"] == os.getpid()]
    assert sorted(c["sent"] for c in mine) == [0, count]
    assert [c["missed"] for c in mine if not c["sent"]] == [0]
    assert len({c["port"] for c in mine}) == 2


def test_an_injected_delay_is_seen_in_the_round_trip_and_logged_with_its_time(
    lab: tuple[str, int], tmp_path: Path
) -> None:
    name, _ = lab
    with attach(name) as one, attach(name) as other:

        def one_way() -> float:
            """Bus time from the end of one's frame to that of the other's reply to it, s."""
            one.send(message(0x10))
            asked = receive(other).timestamp
            other.send(message(0x11))
            return receive(one).timestamp - asked

        plain = min(one_way() for _ in range(20))
        result = hil("inject", f"bus.{name}.delay", "10ms", "--run", name, state=tmp_path)
        assert result.returncode == 0, result.stderr
        delayed = [one_way() for _ in range(5)]
    assert plain < 0.01 <= min(delayed)
    time = re.search(r"from ([\d.]+) s", result.stdout).group(1)  # type: ignore[union-attr]
    told = status(name, tmp_path)
    (injected,) = told["injected"]
    assert (injected["key"], injected["value"]) == (f"bus.{name}.delay", "10ms")
    assert f"{injected['time_s']:.6f}" == time
    assert hil("bus", "down", name, state=tmp_path).returncode == 0
    directory = Path(told["log"])
    events = (directory / "events.log").read_text()
    assert f"({injected['time_s']:.9f}) injected bus.{name}.delay = 10ms\n" in events
    assert json.loads((directory / "status.json").read_text())["injected"] == [injected]


def test_nodes_of_the_bus_itself_load_it_and_babble_and_a_named_bit_is_damaged(
    lab: tuple[str, int], tmp_path: Path
) -> None:
    name, _ = lab
    with attach(name) as listener:
        for key, value in (("background.load", "0.05"), ("babble.rate", "200Hz"), ("damage", "0x001 crc:3")):
            result = hil("inject", f"bus.{name}.{key}", value, "--run", name, state=tmp_path)
            assert result.returncode == 0, result.stderr
        wait_for(lambda: status(name, tmp_path)["errors"] == 1, "the damaged bit")
        heard: set[int] = set()
        wait_for(lambda: heard.add(receive(listener).arbitration_id) or heard >= {0x001, 0x101, 0x110}, "all of them")
    told = status(name, tmp_path)
    assert told["identifiers"]["001"]["retransmitted"] == 1
    assert all(one["retransmitted"] == 0 for key, one in told["identifiers"].items() if key != "001")


def test_what_cannot_be_injected_is_refused(lab: tuple[str, int], tmp_path: Path) -> None:
    name, _ = lab
    for key, value, part in (
        (f"bus.{name}.dela", "1ms", "did you mean"),
        (f"bus.{name}.delay", "1", "has no unit"),
        (f"bus.{name}.loss", "2", "at most 1"),
        ("link.state.delay", "1ms", "unknown key"),
    ):
        result = hil("inject", key, value, "--run", name, state=tmp_path)
        assert (result.returncode, result.stdout) == (2, "") and part in result.stderr, result.stderr
    assert status(name, tmp_path)["injected"] == []


def test_the_log_is_read_back_by_python_can(lab: tuple[str, int], tmp_path: Path) -> None:
    name, pid = lab
    sent = [message(0x100 + n, bytes([n]) * length) for n, length in enumerate((0, 1, 8, 12, 64))]
    sent.append(can.Message(arbitration_id=0x1ABCDEF0, data=b"\x01\x02", is_extended_id=True))
    with attach(name) as sender, attach(name) as listener:
        for frame in sent:
            sender.send(frame)
        heard = [receive(listener) for _ in sent]
    log = Path(status(name, tmp_path)["log"])
    os.kill(pid, signal.SIGINT)
    wait_for(lambda: gone(pid), "the end of the bus")
    read = list(can.LogReader(log / "frames.log"))
    assert [m.timestamp for m in read] == pytest.approx([m.timestamp for m in heard], abs=1e-9)
    for got, expected in zip(read, heard, strict=True):
        assert got.equals(expected, timestamp_delta=None, check_channel=False, check_direction=False)
    assert {m.channel for m in read} == {name}


def test_a_new_bus_of_the_name_keeps_the_log_before(tmp_path: Path) -> None:
    name = unique("lab")
    for _ in range(2):
        assert hil("bus", "up", name, "--log", str(tmp_path / "logs"), state=tmp_path).returncode == 0
        with attach(name) as sender, attach(name) as listener:
            sender.send(message(0x55))
            receive(listener)
        assert hil("bus", "down", name, state=tmp_path).returncode == 0
    for file in ("frames.log", "frames.log.1"):
        assert len((tmp_path / "logs" / file).read_text().splitlines()) == 1
    assert (tmp_path / "logs" / "events.log").read_text().count("up: ") == 2
    assert not (tmp_path / "hume-hil").exists()


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_in_the_foreground_it_ends_with_a_signal_and_status_0(end: signal.Signals, tmp_path: Path) -> None:
    name = unique("lab")
    process = start("bus", "up", name, "--foreground", "--no-log", "--json", state=tmp_path)
    assert process.stdout is not None
    told = json.loads(process.stdout.readline())
    assert told["pid"] == process.pid and told["log"] is None
    with attach(name) as client:
        process.send_signal(end)
        stdout, stderr = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, stdout, stderr) == (0, "", "")
        with pytest.raises(can.CanOperationError, match="ended"):
            client.recv(PATIENCE_S)
    assert list(tmp_path.iterdir()) == []


def test_a_killed_bus_leaves_its_name_free_and_its_log_to_be_read(lab: tuple[str, int], tmp_path: Path) -> None:
    name, pid = lab
    log = Path(status(name, tmp_path)["log"]) / "frames.log"
    with attach(name) as sender:
        sender.send(message(0x1))
        wait_for(lambda: log.stat().st_size > 0, "a line in the log")  # while the bus idles
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(can.CanOperationError, match="ended"):
            sender.recv(PATIENCE_S)
    wait_for(lambda: (name, name) not in served(), "the end of the name")
    assert [m.arbitration_id for m in can.LogReader(log)] == [1]
    again = hil("bus", "up", name, state=tmp_path)
    assert again.returncode == 0, again.stderr
    assert hil("bus", "down", name, state=tmp_path).returncode == 0


def test_a_classical_bus_takes_no_fd_frames(tmp_path: Path) -> None:
    name = unique("lab")
    result = hil("bus", "up", name, "--classic", "500k", "--no-log", state=tmp_path)
    assert result.returncode == 0 and "classical CAN 0.5 Mbit/s" in result.stdout
    classical = can.Message(arbitration_id=0x10, data=b"\xaa" * 8, is_extended_id=False)
    try:
        with attach(name) as sender, attach(name) as listener:
            with pytest.raises(can.CanOperationError, match="classical"):
                sender.send(message(0x1))
            fd, _ = connect(name)  # one that does not know
            fd.send(pack_frame(Frame(0x1, b""), tag=1))
            sender.send(classical)
            sender.send(classical)
            first, second = receive(listener), receive(listener)
            fd.close()
        assert not first.is_fd and first.arbitration_id == 0x10
        frame = Frame(0x10, b"\xaa" * 8, fd=False, brs=False)
        assert second.timestamp - first.timestamp >= frame_ns(frame, 5e5, 5e5) * 1e-9 - 2e-9
        told = status(name, tmp_path)
        assert (told["sent"], told["misfits"], told["data_rate"]) == (2, 1, None)
    finally:
        assert hil("bus", "down", name, state=tmp_path).returncode == 0


def test_faults_from_the_start(tmp_path: Path) -> None:
    name = unique("lab")
    command = ("bus", "up", name, "--no-log", "--seed", "3", "--set", f"bus.{name}.loss=1")
    assert hil(*command, state=tmp_path).returncode == 0
    try:
        with attach(name) as sender:
            sender.send(message(0x1))
            told = wait_for(lambda: (t := status(name, tmp_path))["sent"] and t, "a frame")
        assert (told["sent"], told["lost"], told["lateness"]["events"]) == (1, 1, 0)
        assert told["identifiers"]["001"]["lost"] == 1
    finally:
        assert hil("bus", "down", name, state=tmp_path).returncode == 0


def test_bit_errors_reach_clients_as_error_frames_and_frames_are_sent_again(tmp_path: Path) -> None:
    name = unique("lab")
    command = ("bus", "up", name, "--set", f"bus.{name}.bit_error_rate=0.002", "--json")
    log = Path(json.loads(hil(*command, state=tmp_path).stdout)["log"])
    try:
        with attach(name) as sender, attach(name) as listener:
            for n in range(200):
                sender.send(message(0x1, bytes([n])))
            heard: list[can.Message] = []
            while not heard or heard[-1].is_error_frame or heard[-1].data[0] != 199:
                heard.append(receive(listener))
        told = status(name, tmp_path)
    finally:
        assert hil("bus", "down", name, state=tmp_path).returncode == 0
    # an error in the last bit of a frame comes too late for its receivers: they get it twice, as on a real bus
    assert list(dict.fromkeys(m.data[0] for m in heard if not m.is_error_frame)) == list(range(200))
    assert any(m.is_error_frame for m in heard)
    assert 0 < told["identifiers"]["001"]["retransmitted"] <= told["errors"]
    assert any(m.is_error_frame for m in can.LogReader(log / "frames.log"))


def test_a_full_bus_turns_the_next_client_away_with_a_sentence(lab: tuple[str, int]) -> None:
    name, pid = lab
    connections = [connect(name)[0] for _ in range(32)]
    try:
        with pytest.raises(PortError, match=f"'{name}' has 32 clients already and takes no more"):
            connect(name)
        assert name in buses()  # asked, it still answers
        connections.pop().close()
        wait_for(lambda: _attaches(name), "a free port")
        assert peer(connections[0])[0] == pid
    finally:
        for connection in connections:
            connection.close()


def _attaches(name: str) -> bool:
    try:
        connect(name)[0].close()
    except PortError:
        return False
    return True


def test_periodic_frames_come_in_bus_time_also_on_an_idle_bus(lab: tuple[str, int]) -> None:
    name, _ = lab
    with attach(name) as sender, attach(name) as listener:
        task = sender.send_periodic(message(0x50), 0.005)
        heard = [receive(listener) for _ in range(30)]
        task.stop()
    assert {m.arbitration_id for m in heard} == {0x50}
    # each as late as the machine was, but none of it adds up
    assert heard[-1].timestamp - heard[0].timestamp >= 29 * 0.005 - 0.1


@pytest.mark.parametrize("fault", ["loss=1", "delay=10s"])
def test_a_sender_is_not_slowed_by_what_happens_to_its_frames_behind_the_bus(fault: str, tmp_path: Path) -> None:
    """A controller knows that its frame has been on the bus, not that it arrives."""
    name = unique("lab")
    assert hil("bus", "up", name, "--no-log", "--set", f"bus.{name}.{fault}", state=tmp_path).returncode == 0
    try:
        with attach(name) as sender:
            on_bus = [sender.transmit(message(0x100 + n % 7, bytes([n % 256]))) for n in range(300)]
            times = [sent.result(PATIENCE_S) for sent in on_bus]
        assert len(set(times)) == 300  # one after the other, by arbitration
        told = status(name, tmp_path)
        assert told["sent"] == 300 and told["lateness"]["events"] == 0
    finally:
        assert hil("bus", "down", name, state=tmp_path).returncode == 0


def test_what_a_client_sent_before_it_left_is_still_sent(lab: tuple[str, int]) -> None:
    """Also when it leaves without having read all: the kernel then reports a reset before it gives what waits."""
    name, _ = lab
    with attach(name) as listener, attach(name) as other:
        sender = attach(name)
        other.send(message(0x1))
        assert receive(listener).arbitration_id == 0x1  # sender has it as well, and never reads it
        for _ in range(50):
            sender.send(message(0x2))
        sender.shutdown()
        assert [receive(listener).arbitration_id for _ in range(50)] == [0x2] * 50


def test_malformed_records_are_counted_and_do_no_harm(lab: tuple[str, int], tmp_path: Path) -> None:
    name, _ = lab
    connection, _ = connect(name)
    with attach(name) as sender, attach(name) as listener:
        for junk in (b"x", b"\xff" * 80, bytes(5), b"\0" * 17):
            connection.send(junk)
        sender.send(message(0x7))
        assert receive(listener).arbitration_id == 0x7
        told = wait_for(
            lambda: (t := status(name, tmp_path)) and sum(c["malformed"] for c in t["clients"]) and t, "the count"
        )
    connection.close()
    assert max(c["malformed"] for c in told["clients"]) >= 2


def test_an_idle_bus_sleeps(lab: tuple[str, int]) -> None:
    """A loop that spins is runnable all the time, on however loaded a machine."""
    _, pid = lab
    states = []
    with subprocess.Popen([sys.executable, "-c", "import numpy, can"]) as elsewhere:  # takes some tenths of a second
        while elsewhere.poll() is None:
            states.append(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0])
    assert len(states) > 50 and states.count("S") > 0.8 * len(states)


MISTAKES: dict[tuple[str, ...], str] = {
    ("up", "a b"): "argument NAME: 'a b': expected 1 to 32 letters, digits, _ - or .",
    ("up", "x/y"): "argument NAME: 'x/y': expected 1 to 32 letters, digits, _ - or .",
    ("up", "lab", "--fd", "1M"): "argument --fd: '1M': expected two bit rates such as 1M/5M",
    ("up", "lab", "--fd", "1/5"): "argument --fd: '1': expected a bit rate such as 500k or 1M",
    ("up", "lab", "--fd", "2M/5M"): "argument --fd: '2M': expected 5k to 1M",
    ("up", "lab", "--fd", "1M/9M"): "argument --fd: '9M': expected 5k to 8M",
    ("up", "lab", "--fd", "1M/500k"): "argument --fd: '1M/500k': the data phase cannot be slower than arbitration",
    ("up", "lab", "--classic", "fast"): "argument --classic: 'fast': expected a bit rate such as 500k or 1M",
    ("up", "lab", "--classic", "1M", "--fd", "1M/5M"): "argument --fd: not allowed with argument --classic",
    ("up", "lab", "--set", "loss"): "--set loss: expected KEY=VALUE, for example --set bus.lab.delay=3ms",
    ("up", "lab", "--set", "bus.lab.los=1"): "--set bus.lab.los=1: no such key; did you mean 'bus.lab.loss'?",
    ("up", "lab", "--set", "bus.lab.loss=2"): "bus.lab.loss = '2': expected at most 1",
    ("up", "lab", "--log", "x", "--no-log"): "--log and --no-log contradict each other",
    ("status",): "the following arguments are required: NAME",
}


@pytest.mark.parametrize("arguments", MISTAKES, ids=" ".join)
def test_a_mistake_is_one_sentence(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bus", *arguments]) == 2
    out, err = capsys.readouterr()
    sentence = re.sub(r" \(`hil bus \w+ --help` lists what there is\)", "", err.removeprefix("hil: ")).rstrip("\n")
    assert (out, sentence) == ("", MISTAKES[arguments])


def test_a_wrong_name_is_answered_with_the_nearest(lab: tuple[str, int], capsys: pytest.CaptureFixture[str]) -> None:
    name, _ = lab
    for action in ("status", "down"):
        assert main(["bus", action, name + "x"]) == 2
        assert capsys.readouterr().err == f"hil: no bus {name + 'x'!r}; did you mean {name!r}?\n"


def test_a_directory_that_cannot_be_written_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    for how in ((), ("--foreground",)):
        handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        assert main(["bus", "up", unique("lab"), "--log", str(tmp_path / "file" / "logs"), *how]) == 2
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
        assert f"{tmp_path / 'file' / 'logs'}" in capsys.readouterr().err


def test_a_signal_just_before_the_wait_ends_the_bus() -> None:
    """After Python's last look for signals, before the wait: only what the handler's C part writes wakes it."""
    bus = StandaloneBus(unique("lab"), BusConfig())
    wait, before = bus._selector.select, signal.signal(signal.SIGTERM, lambda *_: bus.stop())
    signal.set_wakeup_fd(bus.wakeup_fd, warn_on_full_buffer=False)

    def late(timeout: float | None = None) -> Any:
        signal.raise_signal(signal.SIGTERM)  # its handler runs when this returns, or would
        bus._stopped = False  # as if it had not yet
        os.eventfd_read(bus.requests.bell)
        assert timeout is None  # it would wait for ever
        ready = wait(PATIENCE_S)
        assert ready
        bus._stopped = True
        return ready

    bus._selector.select = late  # type: ignore[method-assign]
    try:
        bus.serve()
    finally:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGTERM, before)
        bus.close()
