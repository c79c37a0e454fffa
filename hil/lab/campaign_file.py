"""Campaigns: TOML files that list scenarios, faults and what is expected of them."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError

from hil import schema
from hil.errors import UserError
from hil.injection import injectable
from hil.scenario import Scenario, load, parse_value
from robots import description
from robots.quantities import Config, Seconds


def _flat(table: Any, path: str = "") -> Any:
    """Values by whole key, however they are nested: in TOML ``a.b = 1`` is a table within a table."""
    if not isinstance(table, dict):
        return table
    values: dict[str, Any] = {}
    for key, value in table.items():
        values |= _flat(value, f"{path}{key}.") if isinstance(value, dict) else {f"{path}{key}": value}
    return values


Settings = Annotated[dict[str, Any], BeforeValidator(_flat)]  # values by key, as of --set


class Row(Config):
    """One trial: what is wrong, and what is expected then.

    ``stable`` expects the verdict. ``safe_state`` expects that the drive of ``joint`` has stopped ``within`` that time,
    its power off or braking, and that the robot has not fallen by the end, unless it may. ``known_weakness`` excuses a
    verdict and a fall, but no drive that stops too late.
    """

    name: Annotated[str, Field(min_length=1, max_length=120)]
    scenario: str | None = None  # else the campaign's
    set: Settings = Field(default_factory=dict)  # beside the campaign's
    faults: Settings = Field(default_factory=dict)
    at: Seconds | None = None  # else the campaign's; "0s": from the start
    until: Seconds | None = None
    expect: Literal["stable", "safe_state"] = "stable"
    joint: str | None = None  # else the one that the faults are of
    within: Seconds | None = None
    may_fall: bool = False
    known_weakness: str = ""  # why it is known not to come out as expected; it must not, then


class Campaign(Config):
    """Rows, and what they have in common."""

    name: Annotated[str, Field(pattern=r"^[^/\x00-\x1f]{1,64}$")]
    description: str = ""
    scenario: str = "split-terrain"
    set: Settings = Field(default_factory=dict)
    at: Seconds = 0.0  # when the faults begin
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = (0,)
    row: Annotated[tuple[Row, ...], Field(min_length=1)]


class Trial(Config):
    """A row, complete and checked. ``faults`` begin at ``at`` and end at ``until``; those from the start are in
    ``scenario`` instead."""

    row: Row
    scenario: Scenario
    faults: Settings
    at: float
    until: float | None
    joint: str | None


def builtin_campaigns() -> list[str]:
    """Names of the campaigns that come with the package."""
    files = resources.files("hil").joinpath("campaigns").iterdir()
    return sorted(f.name[:-5] for f in files if f.name.endswith(".toml"))


def text_of(name: str) -> str:
    """The campaign ``name`` (built in, or the path of a TOML file) as it is written. Raises UserError."""
    path = Path(name)
    try:
        if path.suffix == ".toml":
            return path.read_text(encoding="utf-8")
        if name in builtin_campaigns():
            return resources.files("hil").joinpath("campaigns", f"{name}.toml").read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{name}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{name}: not valid TOML (byte {error.start} is not UTF-8)") from None
    nearest = schema.nearest(name, builtin_campaigns())
    raise UserError(f"no campaign {name!r}{nearest} (a file of your own ends in .toml)")


def read(name: str) -> Campaign:
    """The campaign ``name``. Raises UserError with place and what would be right."""
    text = text_of(name)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{name}: not valid TOML ({error})") from None
    data.setdefault("name", Path(name).stem)
    try:
        return Campaign.model_validate(data)
    except ValidationError as error:
        errors = error.errors()
        first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
        raise UserError(f"{name}: {_place(first, data)}{schema.sentence(first, Campaign)}") from None


def _place(error: Any, data: dict[str, Any]) -> str:
    """The name of the row that an error is in, which says more than its number."""
    location = error["loc"]
    if len(location) > 1 and location[0] == "row" and isinstance(location[1], int):
        row = data["row"][location[1]]
        if isinstance(row, dict) and isinstance(row.get("name"), str):
            return f"row {row['name']!r}: "
    return ""


def trials(campaign: Campaign) -> list[Trial]:
    """All rows, complete. Raises UserError that names the row."""
    names: set[str] = set()
    found = []
    for row in campaign.row:
        if row.name in names:
            raise UserError(f"row {row.name!r}: there are two of this name")
        names.add(row.name)
        try:
            found.append(_trial(campaign, row))
        except UserError as error:
            raise UserError(f"row {row.name!r}: {error}") from None
    return found


def _trial(campaign: Campaign, row: Row) -> Trial:
    at = campaign.at if row.at is None else row.at
    settings = campaign.set | row.set
    scenario = load(row.scenario or campaign.scenario, settings if at > 0 else settings | row.faults)
    robot = description.load(scenario.robot)
    if at >= scenario.duration:
        raise UserError(f"at = {at:g} s: the scenario ends at {scenario.duration:g} s")
    if row.until is not None and not at < row.until <= scenario.duration:
        raise UserError(f"until = {row.until:g} s: expected more than at, {at:g} s, to {scenario.duration:g} s")
    if at == 0 and row.until is not None:
        raise UserError(f"until = {row.until:g} s: what is there from the start stays; give an at")
    known = injectable(robot)
    if at > 0:
        for key, value in row.faults.items():
            if key not in known:
                raise UserError(f"faults: nothing to inject at {key!r}{schema.nearest(key, list(known))}")
            parse_value(key, value)
    joint = _joint(row, robot)
    if row.expect == "safe_state" and row.within is None:
        raise UserError('within is missing: the time that the drive has for expect = "safe_state", as "50ms"')
    if row.expect == "stable" and (row.within is not None or row.may_fall or row.joint is not None):
        raise UserError('within, may_fall and joint belong to expect = "safe_state"')
    return Trial(
        row=row, scenario=scenario, faults=row.faults if at > 0 else {}, at=at, until=row.until, joint=joint
    )


def _joint(row: Row, robot: description.Robot) -> str | None:
    """Whose drive has to stop."""
    if row.expect != "safe_state":
        return None
    if row.joint is not None:
        if row.joint not in robot.joint_names:
            raise UserError(f"joint = {row.joint!r}: no such joint{schema.nearest(row.joint, robot.joint_names)}")
        return row.joint
    of_joints = {part for key in row.faults for part in key.split(".") if part in robot.joint_names}
    if len(of_joints) != 1:
        raise UserError("joint is missing: the faults do not tell whose drive has to stop")
    return of_joints.pop()
