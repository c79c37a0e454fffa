"""Where two recorded runs part: the first difference in what was injected, in every bus's frames and in every signal.

What is compared is what both records cover. At one instant the order is the calendar's (``hil.system``): frames
delivered, the world, injections, what the drives told, the controller.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from bus import messages
from hil.errors import UserError
from hil.record import journal
from hil.record.signals import Signals, load_tables
from robots import description
from robots.description import Robot

_ORDER = {"frame": 0, "world": 1, "injection": 2, "drives": 3, "controller": 4, "bus": 5}
_COLUMNS = 4  # signals of one row that are named; the rest is counted


@dataclass(frozen=True)
class Difference:
    """node: whose frame or signal it is. kind: frame, injection, or the signals' channel. what: the signal, or the
    frame with the field. a, b: what is in either record, None where there is nothing."""

    time_ns: int
    kind: str
    node: str
    what: str
    a: str | None
    b: str | None

    @property
    def order(self) -> tuple[int, int]:
        return self.time_ns, _ORDER[self.kind]

    def __str__(self) -> str:
        a, b = (text if text is not None else "nothing" for text in (self.a, self.b))
        return f"{self.time_ns * 1e-9:.9f} s  {self.node}: {self.what}: {a} in A, {b} in B"


@dataclass(frozen=True)
class Comparison:
    """differences: the first of every bus, channel's node and of the injections, in order. start: keys of the
    configurations that differ, with both values as written. until_ns: up to where both records go."""

    differences: list[Difference]
    start: dict[str, tuple[str | None, str | None]]
    until_ns: int

    @property
    def first(self) -> Difference | None:
        return self.differences[0] if self.differences else None


def compare(a: Path, b: Path) -> Comparison:
    """The runs recorded in the directories ``a`` and ``b``. Raises UserError for one that holds no run."""
    runs = [_Run(directory) for directory in (a, b)]
    if len({run.robot.name for run in runs}) > 1:
        raise UserError(f"{a} is a run of {runs[0].robot.name}, {b} one of {runs[1].robot.name}")
    until = min(run.end_ns for run in runs)
    found = [d for d in _differences(runs[0], runs[1]) if d.time_ns < until]
    return Comparison(sorted(found, key=lambda d: d.order), _start(runs[0], runs[1]), until)


class _Run:
    """One record."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        head, *entries = journal.read(directory)
        self.origin = head["run"]
        self.injections = [e for e in entries if "key" in e or "frame" in e]
        self.tables = load_tables(directory)
        end = next((e["end_ns"] for e in entries if "end_ns" in e), None)
        if end is None:  # killed: what is complete is what its last digest covers
            end = max((e["time_ns"] for e in entries if "digest" in e), default=0)
        self.end_ns: int = end
        try:
            self.robot: Robot = description.load(self.origin["configuration"]["robot"])
        except (KeyError, description.UnknownRobotError):
            raise UserError(f"{directory / journal.JOURNAL_FILE}: names no robot that is known") from None

    def log(self, bus: str) -> bytes:
        """The whole lines of a bus's log; nothing when the run kept none."""
        try:
            content = (self.directory / f"{bus}.log").read_bytes()
        except FileNotFoundError:
            return b""
        return content[: content.rfind(b"\n") + 1]


def _start(a: _Run, b: _Run) -> dict[str, tuple[str | None, str | None]]:
    from hil.scenario import to_toml

    def lines(run: _Run) -> dict[str, str]:
        pairs = (line.partition(" = ") for line in to_toml(run.origin["configuration"]).splitlines())
        return {key: value for key, _, value in pairs} | {"seed": str(run.origin["seed"])}

    in_a, in_b = lines(a), lines(b)
    keys = [*in_a, *(key for key in in_b if key not in in_a)]
    return {key: (in_a.get(key), in_b.get(key)) for key in keys if in_a.get(key) != in_b.get(key)}


def _differences(a: _Run, b: _Run) -> Iterator[Difference]:
    for one, other in zip_longest(a.injections, b.injections):
        if one != other:
            present = [entry for entry in (one, other) if entry is not None]
            time = min(entry["time_ns"] for entry in present)
            here = [e if e is not None and e["time_ns"] == time else None for e in (one, other)]
            node = next(e.get("bus") or e["key"].rpartition(".")[0] for e in here if e is not None)
            yield Difference(time, "injection", node, "injected", *(_injection(e) for e in here))
            break
    for bus in a.robot.buses:
        logs = a.log(bus.name), b.log(bus.name)
        if all(logs):
            yield from _frames(a.robot, bus.name, *logs)
    for channel in a.tables:
        if channel in b.tables:
            yield from _signals(channel, a.tables[channel], b.tables[channel])


def _injection(entry: dict[str, Any] | None) -> str | None:
    if entry is None:
        return None
    if "key" in entry:
        return f"{entry['key']} = {entry['value']}"
    return f"frame 0x{entry['frame']['id']:03X} {entry['frame']['data']}"


# --- frames -----------------------------------------------------------------------------------------------------


def _frames(robot: Robot, bus: str, a: bytes, b: bytes) -> Iterator[Difference]:
    length = min(len(a), len(b))
    unequal = np.frombuffer(a, np.uint8, length) != np.frombuffer(b, np.uint8, length)
    at = int(np.argmax(unequal)) if unequal.any() else length
    if at == len(a) == len(b):
        return
    begin = a.rfind(b"\n", 0, at) + 1
    lines = [content[begin : content.find(b"\n", begin)].decode("ascii", "replace") for content in (a, b)]
    read = [_Line(line) if line else None for line in lines]
    times = [line.time_ns for line in read if line is not None]
    one, other = read
    if one is not None and other is not None and (one.time_ns, one.identifier) == (other.time_ns, other.identifier):
        yield _content(robot, bus, one, other)
        return
    first = [line if line is not None and line.time_ns == min(times) else None for line in read]
    shown = next(line for line in first if line is not None)
    name, node = _name(robot, bus, shown.identifier)
    moved = " at another time" if None not in read and one.body == other.body else ""  # type: ignore[union-attr]
    texts = [None if line is None else f"{line.identifier} at {line.time_ns * 1e-9:.9f} s" for line in read]
    yield Difference(min(times), "frame", node, f"{name} on {bus}{moved}", *texts)


class _Line:
    """A line of a candump log. ``flags``: what stands before the data of a CAN FD frame."""

    def __init__(self, text: str) -> None:
        try:
            time, _, self.body = text.split(" ")
            seconds, nanoseconds = time.strip("()").split(".")
            self.time_ns = int(seconds) * 1_000_000_000 + int(nanoseconds)
            self.identifier, _, data = self.body.partition("#")
            self.flags = data[:2] if data.startswith("#") else ""
            self.data = bytes.fromhex(data[len(self.flags) :]) if not data.startswith("R") else b""
        except ValueError:
            raise UserError(f"a bus's log holds a line that is none of candump's: {text!r}") from None


def _content(robot: Robot, bus: str, a: _Line, b: _Line) -> Difference:
    name, node = _name(robot, bus, a.identifier)
    if len(a.data) != len(b.data) or a.data == b.data:
        return Difference(a.time_ns, "frame", node, f"{name} on {bus}", a.body, b.body)
    bits = [
        (8 * byte + bit)
        for byte, (one, other) in enumerate(zip(a.data, b.data, strict=True))
        for bit in range(8)
        if (one ^ other) >> bit & 1
    ]
    which = f"bit {bits[0] % 8} of byte {bits[0] // 8}" if len(bits) == 1 else f"{len(bits)} bits"
    fields = [fields for fields in (_fields(robot, bus, a), _fields(robot, bus, b)) if fields]
    if len(fields) == 2:
        parted = [field for field in fields[0] if fields[0][field] != fields[1][field]]
        if parted:
            values = [f"{source[parted[0]]:.9g}" for source in fields]
            more = f" and {len(parted) - 1} more" if len(parted) > 1 else ""
            return Difference(a.time_ns, "frame", node, f"{name} on {bus}, {which}: {parted[0]}{more}", *values)
    return Difference(a.time_ns, "frame", node, f"{name} on {bus}, {which}", a.data.hex(), b.data.hex())


def _fields(robot: Robot, bus: str, line: _Line) -> dict[str, float]:
    """The fields of a drive's state or of a command, SI units; empty for any other frame."""
    identifier = int(line.identifier, 16)
    if identifier & 0x780 == messages.STATE and len(line.data) == messages.STATE_LENGTH:
        return {k: float(v) for k, v in messages.decode_state(line.data)._asdict().items()}
    if identifier == messages.COMMAND and len(line.data) == messages.COMMAND_LENGTH:
        joints = next(b.joints for b in robot.buses if b.name == bus)
        fields = {"counter": float(messages.command_counter(line.data))}
        for slot, joint in enumerate(joints[: messages.SLOTS]):
            setpoint = messages.decode_setpoint(line.data, slot)
            fields |= {f"{field} of {joint}": float(v) for field, v in setpoint._asdict().items()}
        return fields
    return {}


def _name(robot: Robot, bus: str, identifier: str) -> tuple[str, str]:
    """What a frame is, and which node sends it."""
    if len(identifier) == 8:
        number = int(identifier, 16)
        return ("error frame", bus) if number >= 0x20000000 else (f"frame 0x{identifier}", bus)
    number = int(identifier, 16)
    if number == messages.COMMAND:
        return f"command 0x{identifier}", "gateway"
    kinds = {
        messages.STATE: "state", messages.EMERGENCY: "emergency", messages.HEARTBEAT: "heartbeat",
        messages.SDO_RESPONSE: "SDO response",
    }  # fmt: skip
    kind = kinds.get(number & 0x780)
    node = next((joint.name for joint in robot.joints if joint.node_id == number & 0x7F), None)
    if kind is None or node is None:
        return f"frame 0x{identifier}", bus
    return f"{kind} 0x{identifier}", node


# --- signals ----------------------------------------------------------------------------------------------------


def _signals(channel: str, a: Signals, b: Signals) -> Iterator[Difference]:
    """The first difference of every node whose signals the channel has."""
    if a.names != b.names:
        raise UserError(f"the records have different signals in {channel!r}: they are of different versions")
    rows = min(len(a), len(b))
    shifted = a.times[:rows] != b.times[:rows]
    same_until = int(np.argmax(shifted)) if shifted.any() else rows
    if same_until < max(len(a), len(b)):
        times = [int(t.times[same_until]) if same_until < len(t) else None for t in (a, b)]
        at = min(time for time in times if time is not None)
        texts = [None if time is None else f"at {time * 1e-9:.9f} s" for time in times]
        yield Difference(at, channel, channel, "a row", *texts)
    one, other = a.data[:same_until], b.data[:same_until]
    unequal = (one != other) & ~(np.isnan(one) & np.isnan(other))
    nodes = [_node(channel, name) for name in a.names]
    for node in dict.fromkeys(nodes):
        columns = [k for k, own in enumerate(nodes) if own == node]
        parted = unequal[:, columns]
        if parted.any():
            row = int(np.argmax(parted.any(axis=1)))
            which = [k for k in columns if unequal[row, k]]
            names = ", ".join(a.names[k] for k in which[:_COLUMNS])
            more = f" and {len(which) - _COLUMNS} more" if len(which) > _COLUMNS else ""
            values = (f"{table.data[row, which[0]]:.17g}" for table in (a, b))
            yield Difference(int(a.times[row]), channel, node, f"{names}{more}", *values)


def _node(channel: str, signal: str) -> str:
    return signal.rpartition(".")[2] if channel in ("drives", "bus") else channel
