"""What margins, sweeps and linearisations vary: a scenario's numbers and choices by key, with units and bounds.

Every key of the scenario is a quantity, and some factors that act on several keys at once (``DERIVED``). One that can
also be changed while a run goes on (``hil.injection``) is *injectable*: a settled run is continued with each of its
values. Any other holds from the start.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from hil import schema
from hil.errors import UserError
from hil.injection import injectable
from hil.scenario import Scenario, assign, complete, to_toml
from robots import description
from robots.quantities import parse_quantity

Value = float | int | bool | str


@dataclass(frozen=True)
class Quantity:
    """One thing that can be varied. Values are in SI units (``unit``, "" for pure numbers).

    low, high: bounds of a number; ±infinity where there is none. nominal: its value in the scenario. choices: the
    values of one that is no number, if they can be listed.
    """

    key: str
    kind: Literal["number", "integer", "flag", "text"]
    unit: str
    low: float
    high: float
    nominal: Value
    injectable: bool
    choices: tuple[str, ...] = ()

    @property
    def numeric(self) -> bool:
        return self.kind in ("number", "integer")

    def parse(self, text: str) -> Value:
        """Read a value as a person writes it, with its unit. Raises UserError that names the key."""
        if self.kind == "flag":
            if text not in ("true", "false"):
                raise UserError(f"{self.key} = {text!r}: expected true or false")
            return text == "true"
        if self.kind == "text":
            if self.choices and text not in self.choices:
                raise UserError(f"{self.key} = {text!r}: expected one of {', '.join(self.choices)}")
            return text
        return self.checked(self._number(text))

    def _number(self, text: str) -> float:
        try:
            if self.unit:
                return parse_quantity(text, self.unit)
            return int(text, 0) if self.kind == "integer" else float(text)
        except ValueError as error:
            reason = str(error) if self.unit else f"{text!r} is not a number"
            raise UserError(f"{self.key}: {reason}") from None

    def checked(self, value: float) -> float | int:
        """``value``, whole if the quantity is. Raises UserError outside the bounds."""
        if not math.isfinite(value) or not self.low <= value <= self.high:
            bounds = f"{self.shown(self.low)} to {self.shown(self.high)}"
            raise UserError(f"{self.key} = {self.shown(value)}: expected {bounds}")
        return round(value) if self.kind == "integer" else value

    def written(self, value: Value) -> Value:
        """``value`` as a scenario or ``--set`` has it."""
        return f"{value!r} {self.unit}" if self.unit else value

    def shown(self, value: Value) -> str:
        """``value`` for a person: four digits, in a handy multiple of the unit."""
        if isinstance(value, bool):
            return "true" if value else "false"
        if isinstance(value, str):
            return value
        if self.unit == "s" and 0 < abs(value) < 1:
            scale, name = (1e3, "ms") if abs(value) >= 1e-3 else (1e6, "µs")
            return f"{value * scale:.4g} {name}"
        return f"{value:.4g}{' ' + self.unit if self.unit else ''}"

    def applied(self, scenario: Scenario, value: Value) -> Scenario:
        """``scenario`` with this value from the start. Raises UserError when the scenario does not take it."""
        return changed(scenario, {self.key: self.written(value)})


def quantity(scenario: Scenario, key: str) -> Quantity:
    """The quantity ``key`` of ``scenario``. Raises UserError, with the nearest name, if it has none."""
    if key in DERIVED:
        return Quantity(key, "number", "", 0.0, math.inf, 1.0, injectable=False)
    known = injectable(description.load(scenario.robot))
    found = schema.field(Scenario, key)
    if found is None or not (key in known or _present(scenario, key)):
        keys = [*DERIVED, *known, *schema.leaves(Scenario, scenario.model_dump(mode="json"))]
        close = difflib.get_close_matches(key, keys, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"expected a key of the scenario, or {', '.join(DERIVED)}"
        raise UserError(f"no quantity {key!r}; {hint}")
    if found.kind == "other":
        raise UserError(f"{key} is not a single value")
    nominal = _value(scenario, key)
    if nominal is None:
        nominal = known[key].default if key in known else ""
    return Quantity(key, found.kind, found.unit, found.low, found.high, nominal, key in known, found.choices)


def changed(scenario: Scenario, values: dict[str, Value]) -> Scenario:
    """``scenario`` with ``values``, as written (with units), by key, from the start. Raises UserError."""
    data = as_written(scenario)
    for key, value in values.items():
        if key in DERIVED:
            DERIVED[key](data, factor=float(value))
        else:
            assign(data, key, value)
    return complete(data, scenario.name)


def as_written(scenario: Scenario) -> dict[str, Any]:
    """``scenario`` as its file would hold it, with units."""
    return tomllib.loads(to_toml(scenario.model_dump(mode="json")))


def _value(scenario: Scenario, key: str) -> Any:
    node: Any = scenario
    for part in key.split("."):
        node = node.get(part) if isinstance(node, dict) else getattr(node, part, None)
        if node is None:
            return None
    return node


def _present(scenario: Scenario, key: str) -> bool:
    """Whether the scenario has a table at ``key``'s parent, of which ``key`` is a field."""
    parent = key.rpartition(".")[0]
    return not parent or _value(scenario, parent) is not None


def _scaled_torque_gains(data: dict[str, Any], powers: Mapping[str, float], factor: float) -> None:
    firmware = data["firmware"]
    tables = [firmware["stance"], firmware["swing"]]
    tables += [own for joint in firmware.get("joints", {}).values() for own in joint.values()]
    _scaled(tables, powers, factor)


def _scaled_task_gains(data: dict[str, Any], powers: Mapping[str, float], factor: float) -> None:
    _scaled([gains for gains in data["controller"]["tasks"].values() if isinstance(gains, dict)], powers, factor)


def _scaled(tables: Iterable[dict[str, Any]], powers: Mapping[str, float], factor: float) -> None:
    for gains in tables:
        for name, written in gains.items():
            if name not in powers:
                continue
            number, _, unit = str(written).partition(" ")
            value = factor ** powers[name] * float(number)
            gains[name] = f"{value!r} {unit}" if unit else value


# Factors, 1 by default, that act on a scenario as it is written: each gain times the factor to this power.
DERIVED: dict[str, Callable[..., None]] = {
    # all gains of all torque loops: their ratios, and with them the shape of the loop, stay
    "joint.torque_gain": partial(_scaled_torque_gains, powers={"kp": 1, "ki": 1, "kd": 1}),
    # what is fed back of the torque; the damping of the motor stays
    "joint.torque_feedback": partial(_scaled_torque_gains, powers={"kp": 1, "ki": 1}),
    # all gains of all tasks: s → s / factor, the damping ratios stay
    "controller.task_bandwidth": partial(_scaled_task_gains, powers={"kp": 2, "kd": 1, "ki": 3}),
    "controller.task_damping": partial(_scaled_task_gains, powers={"kd": 1}),
}
