"""What is tested on real SocketCAN: each test returns what was seen, or raises.

candump and canopen are the witnesses: neither shares code with what they watch.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.errors import EmulationError

_DURATION = "50ms"  # simulated, of each run
_PATIENCE_S = 20.0  # for what must come at once, on a slow machine


class NotRun(Exception):
    """A test has nothing to test here, and says why."""


def _expect(condition: bool, what: str) -> None:
    if not condition:
        raise EmulationError(what)


def _listeners(interface: str) -> int:
    """How many receivers the kernel has for the frames of an interface."""
    tables = "".join(path.read_text() for path in Path("/proc/net/can").glob("rcvlist_*"))
    return len(re.findall(rf"^ +{re.escape(interface)} +[0-9a-f]", tables, re.M))


class Candump:
    """``candump -L`` of can-utils on one interface; ``match``: only for identifiers that match (``200:7FF``)."""

    def __init__(self, interface: str, match: str = "") -> None:
        before = _listeners(interface)
        command = ["candump", "-L", f"{interface},{match}" if match else interface]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + _PATIENCE_S
        while _listeners(interface) == before:
            _expect(time.monotonic() < deadline and self._process.poll() is None, f"candump does not hear {interface}")
            time.sleep(0.005)

    def frames(self, count: int) -> list[Any]:
        """At least the next ``count`` frames that it prints."""
        import can

        from bus.python_can import to_frame

        assert self._process.stdout is not None
        text, descriptor = b"", self._process.stdout.fileno()
        while text.count(b"\n") < count:
            if not select.select([descriptor], [], [], _PATIENCE_S)[0]:
                raise EmulationError(f"candump saw {len(text.splitlines())} of {count} frames")
            text += os.read(descriptor, 1 << 16)
        return [to_frame(message) for message in can.CanutilsLogReader(io.StringIO(text.decode()))]

    def __enter__(self) -> Candump:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


def _carried(frame: Any) -> bool:
    """Whether python-can's form of a frame is one that the bus takes back."""
    import can

    from bus.python_can import to_frame, to_message

    try:
        return to_frame(to_message(frame, 0, "")) == frame
    except can.CanOperationError:
        return False


def _every_length() -> str:
    """Every kind and length of frame crosses the kernel unchanged."""
    import can

    from bus.frames import CAN_FD_LENGTHS, ErrorFrame, Frame
    from bus.socketcan import Interfaces, SocketCanPort

    frames = [Frame(0x7FF, bytes(range(n)), False, False) for n in range(9)]
    frames += [Frame(0x1ABCDEF0 + n, bytes(range(n)), False, False, True) for n in range(9)]
    frames += [Frame(0x123, bytes(range(n)), True, brs, extended) for n in CAN_FD_LENGTHS
               for brs in (False, True) for extended in (False, True)]  # fmt: skip
    more = [Frame(0x55, bytes(n), False, False, remote=True) for n in range(9)] + [Frame(0x66, bytes(12), esi=True)]
    frames += [frame for frame in more if _carried(frame)]
    with Interfaces(["hiltest0"]), Candump("hiltest0") as candump:
        sender, receiver = SocketCanPort("hiltest0"), SocketCanPort("hiltest0")
        for frame in frames:
            sender.send_frame(frame)
        _expect(receiver.take(len(frames), _PATIENCE_S) == frames, "python-can received other frames than were sent")
        _expect(candump.frames(len(frames)) == frames, "candump saw other frames than were sent")
        receiver.shutdown()
        with can.Bus(interface="socketcan", channel="hiltest0", fd=True) as stock:
            sender.send_error(ErrorFrame(0x20C, bytes([0, 8, 0, 0, 0, 0, 120, 0])))
            heard = stock.recv(_PATIENCE_S)
        told = heard is not None and heard.is_error_frame and heard.arbitration_id == 0x20C
        _expect(told, f"an error frame was received as {heard}")
        sender.shutdown()
    return f"{len(frames)} frames, all kinds and lengths, seen by a socket and by candump; an error frame by python-can"


class Leg:
    """The three firmware nodes of a leg and the gateway, each with a socket of its own on one interface."""

    interface = "hiltest1"

    def __init__(self) -> None:
        import numpy as np

        from bus.gateway import Gateway
        from bus.socketcan import SocketCanPort
        from hil.scenario import load
        from joint_firmware.firmware import JointFirmware
        from robots import description, pins

        config = load("stand", []).firmware.model_copy(update={"boot_time": 0.002, "heartbeat_period": 0.01})
        robot = description.load("hume")
        self.bus = next(n for n, bus in enumerate(robot.buses) if bus.name == "left_leg")
        names = robot.buses[self.bus].joints
        self.nodes = [JointFirmware(robot, robot.joint_names.index(name), config) for name in names]
        for node, name in zip(self.nodes, names, strict=True):
            inputs = np.zeros(pins.N_INPUTS, np.int32)
            # without its supply a drive would trip
            inputs[pins.SUPPLY_ADC] = round(robot.joint(name).actuator.supply_voltage / pins.VOLT_PER_COUNT)
            node.attach(inputs, np.zeros(pins.N_OUTPUTS, np.int32))
        self.gateway = Gateway(robot)
        self.ports = [SocketCanPort(self.interface) for _ in self.nodes]
        self.gateway_port = SocketCanPort(self.interface)
        self.sent: list[Any] = []  # in the order in which the kernel got them
        self._rate, self._tick, self._counter = int(config.rate), 0, 0
        self._waiting = [0] * len(self.nodes)

    def tick(self, controlword: int | None = None) -> list[Any]:
        """One tick of all nodes, after a command of the gateway's if there is one. Returns what it forwards."""
        from bus import messages

        if controlword is not None:
            self._counter += 1
            setpoints = [messages.Setpoint(controlword, messages.Mode.TORQUE)] * len(self.nodes)
            data = messages.encode_command(self._counter, setpoints)
            _, frame = self.gateway.from_link((self.bus, messages.COMMAND, data))
            self.gateway_port.send_frame(frame)
            self.sent.append(frame)
            self._waiting = [n + 1 for n in self._waiting]
        now = self._tick * 1_000_000_000 // self._rate
        self._tick += 1
        count = 0
        for n, (node, port) in enumerate(zip(self.nodes, self.ports, strict=True)):
            frames, self._waiting[n] = port.take(self._waiting[n], _PATIENCE_S), 0
            for frame in node.tick(now, frames):
                port.send_frame(frame)
                self.sent.append(frame)
                count += 1
                self._waiting = [w + (other != n) for other, w in enumerate(self._waiting)]
        received = self.gateway_port.take(count, _PATIENCE_S)
        return [item for frame in received if (item := self.gateway.from_can(now, self.bus, frame)) is not None]

    def close(self) -> None:
        for port in [*self.ports, self.gateway_port]:
            port.shutdown()


def _firmware_and_gateway() -> str:
    """Drives walk through their states on commands from the gateway; candump sees each frame, byte for byte."""
    from bus import messages
    from bus.socketcan import Interfaces

    Word = messages.Controlword
    with Interfaces([Leg.interface]), Candump(Leg.interface) as candump:
        leg = Leg()
        for word in [None] * 10 + [Word.SHUTDOWN] * 3 + [Word.SWITCH_ON] * 3 + [Word.ENABLE_OPERATION] * 6:
            items = leg.tick(word)
        for _ in range(2):
            items = items if any(i[1] & 0x780 == messages.STATE for i in items) else leg.tick(Word.ENABLE_OPERATION)
        states = [messages.decode_state(data) for _, can_id, data in items if can_id & 0x780 == messages.STATE]
        words = [state.statusword & messages.Statusword.MASK for state in states]
        _expect(words == [messages.Statusword.OPERATION_ENABLED] * 3, f"the gateway got the statuswords {words}")
        seen = candump.frames(len(leg.sent))
        _expect(seen == leg.sent, "candump saw other frames than the nodes sent")
        leg.close()
    return f"3 drives to operation enabled by the gateway's commands, {len(seen)} frames seen by candump"


def _canopen_master() -> str:
    """A stock canopen master finds the nodes by their heartbeats, across the kernel."""
    if importlib.util.find_spec("canopen") is None:
        raise NotRun("the package canopen is not installed")
    import canopen

    from bus.socketcan import Interfaces

    with Interfaces([Leg.interface]):
        leg = Leg()
        network = canopen.Network()
        network.connect(interface="socketcan", channel=Leg.interface, fd=True)
        try:
            nodes = {n.node_id: network.add_node(n.node_id, canopen.ObjectDictionary()) for n in leg.nodes}
            deadline = time.monotonic() + _PATIENCE_S
            while {master.nmt.state for master in nodes.values()} != {"OPERATIONAL"}:
                _expect(time.monotonic() < deadline, "canopen has not heard all heartbeats")
                leg.tick()
                time.sleep(0.001)  # the master's thread
            found = sorted(network.scanner.nodes)
            _expect(found == sorted(nodes), f"canopen's scanner found {found}, not {sorted(nodes)}")
        finally:
            network.disconnect()
            leg.close()
    return f"nodes {found} found and heard as operational"


def _canopen_sdo() -> str:
    """The master reads the identity of a node by SDO, and is refused what there is not."""
    if importlib.util.find_spec("joint_firmware.object_dictionary") is None:
        raise NotRun("this firmware has no SDO server")
    import threading

    import canopen

    from bus.socketcan import Interfaces, SocketCanPort

    with Interfaces([Leg.interface]):
        leg = Leg()
        for _ in range(20):  # a drive that boots does not answer
            leg.tick()
        network = canopen.Network()
        network.connect(interface="socketcan", channel=Leg.interface, fd=True)
        done = threading.Event()
        node = network.add_node(leg.nodes[0].node_id, canopen.ObjectDictionary())
        node.sdo.RESPONSE_TIMEOUT = _PATIENCE_S
        seen: dict[str, Any] = {}

        def ask() -> None:
            try:
                seen["identity"] = node.sdo.upload(0x1018, 1)
                node.sdo.upload(0x5FFF, 0)
            except canopen.SdoAbortedError as error:
                seen["abort"] = error.code
            finally:
                done.set()

        master = threading.Thread(target=ask, daemon=True)
        watcher = SocketCanPort(Leg.interface)  # sees what the master sends, as the nodes' sockets do
        master.start()
        deadline = time.monotonic() + _PATIENCE_S
        while not done.is_set() and time.monotonic() < deadline:
            _, heard = watcher.waiting()
            requests = sum(frame.id & 0x780 == 0x600 for frame in heard)
            leg._waiting = [n + requests for n in leg._waiting]
            leg.tick()
            time.sleep(0.001)
        network.disconnect()
        watcher.shutdown()
        leg.close()
    _expect(len(seen.get("identity", b"")) == 4, f"no identity by SDO: {seen}")
    _expect(seen.get("abort") == 0x06020000, f"an unknown object was not refused with 0x06020000: {seen}")
    return f"identity {seen['identity'].hex()} read, unknown object refused with 0x06020000"


def _run(mode: str, backend: str = "processes", watch: str | None = None) -> tuple[str, int]:
    """Digest of a short run of ``stand`` and how many frames candump has seen on ``watch`` just as they were logged."""
    import can

    from bus.python_can import to_frame
    from hil.run import Request, run
    from hil.scenario import load

    seen: list[Any] = []
    with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as stack:
        out = Path(scratch) / f"selftest-{mode}-{backend}"
        candumps = []

        def prepare(_: Any) -> None:
            if watch is not None:
                candumps.append(stack.enter_context(Candump(watch)))

        request = Request(load("stand", [f"duration={_DURATION}"]), backend=backend, out=out, report=False, can=mode)
        outcome = run(request, prepare=prepare)
        _expect(outcome.record["verdict"] != "failed", outcome.record["reason"])
        if watch is not None:
            logged = [to_frame(message) for message in can.CanutilsLogReader(out / "left_leg.log")]
            seen = candumps[0].frames(len(logged))
            _expect(seen == logged, f"candump on {watch} saw other frames than the run has logged")
    return outcome.record["log_digest"], len(seen)


def _timed_run() -> str:
    """``hil run stand --can socketcan`` has the digest of the run in one process."""
    digest, frames = _run("socketcan", watch="left_leg")
    reference, _ = _run("shm", backend="inline")
    _expect(digest == reference, f"digest {digest} over SocketCAN, {reference} in one process")
    return f"{_DURATION} of stand, digest {digest[:16]} as in one process; {frames} frames seen by candump as logged"


def _plain_run() -> str:
    """``hil run stand --can socketcan-plain``, twice, has one digest."""
    digest, frames = _run("socketcan-plain", watch="left_leg")
    again, _ = _run("socketcan-plain")
    _expect(digest == again, f"digest {digest}, then {again}")
    return f"{_DURATION} of stand twice, digest {digest[:16]}; {frames} frames seen by candump as logged"


def _external_joint() -> str:
    """A run in wall-clock time leaves one joint to a drive that is a program of its own on the joint's interface."""
    if importlib.util.find_spec("hil.commands.joint_command") is None:
        raise NotRun("this version has no `hil joint`")
    from bus import messages
    from hil.run import Request, run
    from hil.scenario import load

    interface, node = "right_leg.3", 3
    options = ["--node", str(node), "--can", f"socketcan:{interface}", "--rate", "300Hz"]
    with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as stack:
        candumps = []

        def prepare(assembly: Any) -> None:
            for pid in assembly.pids.values():  # real-time priority, late and on one core, would starve the drive
                os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))
            candumps.append(stack.enter_context(Candump(interface, f"{messages.COMMAND:X}:7FF")))
            states = stack.enter_context(Candump(interface, f"{messages.STATE + node:X}:7FF"))
            drive = subprocess.Popen([sys.executable, "-m", "hil", "joint", *options], stdout=subprocess.DEVNULL)
            stack.callback(drive.wait)
            stack.callback(drive.kill)
            states.frames(1)  # it is there

        scenario = load("stand", [f"duration={_DURATION}"])
        out = Path(scratch) / "selftest-external"
        record = run(
            Request(scenario, clock="wall", out=out, report=False, can="socketcan", external=(node,)), prepare=prepare
        ).record
        _expect(record["verdict"] != "failed", record["reason"])
        log = (out / "right_leg.log").read_text()
        states = log.count(f" {messages.STATE + node:03X}#")
        commands = len(candumps[0].frames(1))
    _expect(states > 0, "the run has not heard the drive")
    return f"node {node} by `hil joint`: {states} of its states in the run's log, {commands} commands seen by candump"


def _removal() -> str:
    """Interfaces go with the process that made them, also when it is killed."""
    from bus.socketcan import exists

    code = "from bus.socketcan import Interfaces\nkept = Interfaces(['hiltest2'])\nprint('up', flush=True)\ninput()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        _expect(process.stdout.readline() == b"up\n" and exists("hiltest2"), "hiltest2 was not created")
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + _PATIENCE_S
    while exists("hiltest2"):
        _expect(time.monotonic() < deadline, "hiltest2 is still there")
        time.sleep(0.01)
    names = [name for name in ("left_leg", "left_leg.6", "right_leg.3", Leg.interface) if exists(name)]
    _expect(not names, f"left behind: {names}")
    return "interfaces of a killed process and of the runs before are gone"


TESTS: dict[str, Callable[[], str]] = {
    "frames": _every_length,
    "firmware and gateway": _firmware_and_gateway,
    "canopen master": _canopen_master,
    "canopen SDO": _canopen_sdo,
    "timed run": _timed_run,
    "plain run": _plain_run,
    "external joint": _external_joint,
    "removal": _removal,
}
