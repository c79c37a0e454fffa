"""Everything that can be injected: what it is called, what values it takes, and how it is applied while a run goes on.

An injectable key is a key of the scenario: what a scenario sets for the whole run can be changed while it goes on.
The fields of ``bus.config`` and of ``plant.config.JointFaults`` are the registry: their units, bounds, defaults and
descriptions are what is listed, what values are checked against, and what the documentation of a key is.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bus.config import Babble, Background, Burst, BusConfig, Impairment, LinkConfig, NodeFaults
from hil.errors import UserError
from hil.record.journal import Journal
from plant.config import JointFaults, MotionCaptureConfig
from robots.description import Robot

if typing.TYPE_CHECKING:
    from hil.scenario import Scenario

GATEWAY = "gateway"  # a node of every bus
OTHERS = "others"  # of a stand-alone bus: all nodes that are no client
OF_JOINTS = ("node_id", "drift")  # faults that only a joint can have


@dataclass(frozen=True)
class Injectable:
    """One key: its range and default as a person writes them, and what it means."""

    key: str
    unit: str
    range: str
    default: Any
    meaning: str

    def written(self, value: Any) -> Any:
        """``value`` (SI) as a scenario would hold it."""
        return f"{value!r} {self.unit}" if self.unit else value


def injectable(robot: Robot) -> dict[str, Injectable]:
    """All that can be injected into a run of ``robot``, by key."""
    entries: dict[str, Injectable] = {}
    for name, field in LinkConfig.model_fields.items():
        if name != "motion_capture" or robot.motion_capture is not None:
            entries |= _by_key(_fields(_model(field), f"link.{name}"))
    if robot.motion_capture is not None:
        entries |= _by_key(_fields(MotionCaptureConfig, "motion_capture", without=("enabled",)))
    for bus in robot.buses:
        entries |= of_bus(bus.name, (GATEWAY,), bus.joints)
    for joint in robot.joint_names:
        entries |= of_joint(joint)
    return entries


def of_joint(name: str) -> dict[str, Injectable]:
    """All that can be injected into one joint."""
    return _by_key(_fields(JointFaults, f"joint.{name}"))


def of_bus(name: str, nodes: Sequence[str] = (), joints: Sequence[str] = ()) -> dict[str, Injectable]:
    """All that can be injected into one bus with these nodes, some of which are joints."""
    path = f"bus.{name}"
    entries = _by_key(_fields(Impairment, path))
    entries |= _by_key(_fields(BusConfig, path, only=("damage",)))
    entries |= _by_key(_fields(Babble, f"{path}.babble")) | _by_key(_fields(Background, f"{path}.background"))
    for node in nodes:
        entries |= _by_key(_fields(NodeFaults, f"{path}.node.{node}", without=OF_JOINTS))
    for joint in joints:
        entries |= _by_key(_fields(NodeFaults, f"{path}.node.{joint}"))
    return entries


def of_standalone_bus(name: str, clients: Sequence[str] = ()) -> dict[str, Injectable]:
    """All that can be injected into a stand-alone bus with these clients."""
    return of_bus(name, clients) | _by_key(_fields(NodeFaults, f"bus.{name}.node.{OTHERS}", only=("cut",)))


def _model(field: FieldInfo) -> type[BaseModel]:
    assert isinstance(field.annotation, type)
    return field.annotation


def _by_key(entries: Iterable[Injectable]) -> dict[str, Injectable]:
    return {entry.key: entry for entry in entries}


def _fields(
    model: type[BaseModel], path: str, without: Sequence[str] = (), only: Sequence[str] = ()
) -> Iterator[Injectable]:
    for name, field in model.model_fields.items():
        if only and name not in only:
            continue
        if field.annotation is Burst:
            yield from _fields(Burst, f"{path}.{name}")
        elif name not in without:
            extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            unit = str(extra.get("unit", ""))
            yield Injectable(f"{path}.{name}", unit, _range(field, unit), field.default, field.description or "")


def _range(field: FieldInfo, unit: str) -> str:
    if field.annotation is bool:
        return "true or false"
    if typing.get_origin(field.annotation) is typing.Literal:
        return ", ".join(map(str, typing.get_args(field.annotation)))
    if field.annotation is str:
        return "IDENTIFIER BIT [ATTEMPT]"
    low, high = _bounds(field)
    return f"{low:g} to {high:g}{' ' + unit if unit else ''}"


def _bounds(field: FieldInfo) -> tuple[float, float]:
    """The least and the greatest value that ``field`` takes, of all that its type and its own annotation demand."""
    low = max(m.ge for m in field.metadata if isinstance(m, annotated_types.Ge))  # type: ignore[type-var]
    high = min(m.le for m in field.metadata if isinstance(m, annotated_types.Le))  # type: ignore[type-var]
    return low, high  # type: ignore[return-value]


Set = Callable[[str, Any, int], None]  # key, value in SI units, time in ns


class Injector:
    """Applies changes, those of the scenario at their times and those that arrive, and keeps the record of all.

    setters: who takes the keys under a path; the longest path that fits takes it.
    """

    def __init__(self, scenario: Scenario, robot: Robot, setters: Mapping[str, Set], journal: Journal) -> None:
        self._known = injectable(robot)
        self._setters = dict(sorted(setters.items(), key=lambda item: -len(item[0])))
        self._journal = journal
        self._values = {key: configured(scenario, key, entry.default) for key, entry in self._known.items()}
        changes: list[tuple[int, int, str, Any]] = []  # at, number, key, value
        for n, injection in enumerate(scenario.inject):
            changes.append((round(injection.at * 1e9), n, injection.key, injection.value))
            if injection.until is not None:
                changes.append((round(injection.until * 1e9), n, injection.key, None))  # None: as it was before
        self._schedule = sorted(changes, key=lambda change: (change[0], change[3] is not None, change[1]))
        self._scheduled = 0
        self._before: dict[int, Any] = {}  # by number of the injection: the value that it has replaced
        self.injected: list[dict[str, Any]] = []
        for key, value in self._values.items():
            # all others are built with their configuration
            with_set = key.startswith("joint.") or ".node." in key or key.endswith(".damage")
            if with_set and value != self._known[key].default:
                self._set(key, value, 0)

    @property
    def from_outside(self) -> int:
        """How many of the changes so far are not the scenario's."""
        return sum(entry["by"] != "scenario" for entry in self.injected)

    @property
    def values(self) -> Mapping[str, Any]:
        """What is in force now, in SI units, by key."""
        return self._values

    def inject(self, now_ns: int, key: str, value: Any, by: str = "query") -> Any:
        """Change one value from now on. Returns it in SI units; raises UserError for a wrong key or value."""
        from hil.scenario import parse_value

        parsed = parse_value(key, value)
        self._set(key, parsed, now_ns)
        self._values[key] = parsed
        entry = {"time_ns": now_ns, "key": key, "value": value, "by": by}
        self._journal.write(entry)
        self.injected.append({"time_s": now_ns * 1e-9, **entry})
        return parsed

    def _set(self, key: str, value: Any, now_ns: int) -> None:
        for path, setter in self._setters.items():
            if key.startswith(f"{path}."):
                try:
                    return setter(key[len(path) + 1 :], value, now_ns)
                except KeyError:
                    break
        raise UserError(f"nothing to inject at {key!r}")

    def apply_due(self, now_ns: int) -> None:
        """Make the scenario's changes that are due."""
        while self._scheduled < len(self._schedule) and self._schedule[self._scheduled][0] <= now_ns:
            _, n, key, value = self._schedule[self._scheduled]
            self._scheduled += 1
            if value is None:
                value = self._known[key].written(self._before.pop(n))
            else:
                self._before[n] = self._values[key]
            self.inject(now_ns, key, value, by="scenario")

    def snapshot(self) -> dict[str, Any]:
        return {
            "scheduled": self._scheduled,
            "values": dict(self._values),
            "before": dict(self._before),
            "injected": list(self.injected),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._scheduled = state["scheduled"]
        self._values, self._before = dict(state["values"]), dict(state["before"])
        self.injected = list(state["injected"])


def configured(scenario: Scenario, key: str, default: Any) -> Any:
    """The value of ``key`` at the start."""
    node: Any = scenario
    for part in key.split("."):
        node = node.get(part) if isinstance(node, Mapping) else getattr(node, part)
        if node is None:
            return default
    return node
