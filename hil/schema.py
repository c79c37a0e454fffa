"""What a pydantic schema tells a person: what is wrong with a value, and a configuration as TOML with units."""

from __future__ import annotations

import difflib
import json
import math
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

_BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}


def sentence(error: Any, model: type[BaseModel]) -> str:
    """One pydantic error as one sentence: the key's path, what is wrong, what would be right."""
    parts: list[str] = []
    kind: Any = model
    unit = None
    for part in error["loc"]:
        above = kind
        kind, unit = _below(kind, part)
        if kind is None and error["type"] != "extra_forbidden":
            kind = above  # pydantic's name for a member of a union, not a key
            break
        parts.append(str(part))
    path = ".".join(parts)
    if error["type"] == "extra_forbidden":
        return f"unknown key {path!r}{nearest(parts[-1], _keys_of(above), '.'.join(parts[:-1]))}"
    if error["type"] == "missing" and parts[-1].isdigit():
        path = ".".join(parts[:-1])
        return f"{path} = {_short(error['input'])}: expected {len(typing.get_args(above))} values"
    if error["type"] == "missing":
        return f"{path} is missing"
    return f"{path} = {_short(error['input'])}: {_expectation(error, kind, unit)}"


def _expectation(error: Any, kind: Any, unit: str | None) -> str:
    context = error.get("ctx", {})
    of_unit = f" {unit}" if unit else ""
    bounds = [
        f"expected {words} {context[key]:g}{of_unit}" for key, words in _BOUNDS.items() if key in context
    ]
    if bounds:
        return bounds[0]
    match error["type"]:
        case "literal_error":
            return f"expected {context['expected']}"
        case "model_type" | "dict_type":
            keys = _keys_of(kind)
            return f"expected a table with {', '.join(keys)}" if keys else "expected a table of tables"
        case "tuple_type":
            return "expected a list"
        case "too_long":
            return f"expected {context['max_length']} values"
        case "string_type":
            return "expected a text in quotes"
        case "string_pattern_mismatch":
            return "expected 1 to 64 characters, none of / * $ ? #"
        case "float_type" | "float_parsing" | "finite_number":
            return "expected a finite number"
        case "int_type" | "int_parsing" | "int_from_float":
            return "expected a whole number"
        case "bool_type" | "bool_parsing":
            return "expected true or false"
    message = error["msg"].removeprefix("Value error, ")
    return message[0].lower() + message[1:]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _below(kind: Any, part: str | int) -> tuple[Any, str | None]:
    """Type and unit of what lies under ``part`` of a table or list ``kind``; (None, None) for nothing."""
    return _look_below(kind, part)[:2]


def _look_below(kind: Any, part: str | int) -> tuple[Any, str | None, tuple[Any, ...]]:
    """Type, unit and metadata of what lies under ``part`` of a table or list ``kind``; None for nothing."""
    metadata: tuple[Any, ...] = ()
    inner: Any = None
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        if part in kind.model_fields:
            field = kind.model_fields[str(part)]
            inner, metadata = field.annotation, (field,)
    elif typing.get_origin(kind) is dict:
        inner = typing.get_args(kind)[1]
    elif typing.get_origin(kind) is tuple and isinstance(part, int):
        inner = typing.get_args(kind)[0]
    if typing.get_origin(inner) in (typing.Union, types.UnionType):
        inner = next(a for a in typing.get_args(inner) if a is not type(None))
    if typing.get_origin(inner) is Annotated:
        inner, *more = typing.get_args(inner)
        metadata = (*metadata, *more)
    extras = [m.json_schema_extra for m in metadata if isinstance(m, FieldInfo) and m.json_schema_extra]
    return inner, next((str(e["unit"]) for e in extras if isinstance(e, dict) and "unit" in e), None), metadata


def _keys_of(kind: Any) -> list[str]:
    return list(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


class Field(typing.NamedTuple):
    """A single value of a schema: what it holds, its unit ("" without), bounds of a number (±infinity: none)."""

    kind: typing.Literal["number", "integer", "flag", "text", "other"]
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]


def field(model: type[BaseModel], key: str) -> Field | None:
    """What ``model`` holds at ``key`` (with dots); None for an unknown key."""
    kind: Any = model
    unit, metadata = None, ()
    for part in key.split("."):
        kind, unit, metadata = _look_below(kind, part)
        if kind is None:
            return None
    low, high = -math.inf, math.inf
    for bound in _constraints(metadata):
        low = max(low, getattr(bound, "ge", getattr(bound, "gt", -math.inf)))
        high = min(high, getattr(bound, "le", getattr(bound, "lt", math.inf)))
    choices: tuple[str, ...] = ()
    if typing.get_origin(kind) is typing.Literal:
        values = typing.get_args(kind)
        choices, kind = tuple(map(str, values)), type(values[0])
    names: dict[Any, Any] = {float: "number", int: "integer", bool: "flag", str: "text"}
    return Field(names.get(kind, "other"), unit or "", low, high, choices)


def _constraints(metadata: typing.Iterable[Any]) -> Iterator[Any]:
    for item in metadata:
        if isinstance(item, FieldInfo):
            yield from _constraints(item.metadata)
        else:
            yield item


def leaves(model: type[BaseModel], configuration: Mapping[str, Any]) -> list[str]:
    """The keys of all single values in ``configuration`` (a ``model_dump`` of ``model``)."""
    return [path for path, _ in _leaves("", configuration, model, None)]


def nearest(name: str, valid: typing.Sequence[str], table: str = "") -> str:
    """End of a sentence about the unknown ``name``: the nearest of ``valid`` (keys of ``table``), or all."""
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {f'{table}.{close[0]}' if table else close[0]!r}?"
    return f"; valid are {', '.join(valid)}" if valid else ""


def to_toml(configuration: Mapping[str, Any], model: type[BaseModel]) -> str:
    """``configuration`` (a ``model_dump`` of ``model``) as TOML with units, one line per value."""
    return "".join(f"{path} = {_toml(value)}\n" for path, value in _leaves("", configuration, model, None))


def _leaves(path: str, value: Any, kind: Any, unit: str | None) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, below in value.items():
            inner, inner_unit = _below(kind, key)
            name = key if key.replace("_", "").isalnum() and key.isascii() else _toml(key)
            yield from _leaves(f"{path}.{name}" if path else name, below, inner, inner_unit)
    elif value is not None:
        yield path, _with_units(value, kind, unit)


def _with_units(value: Any, kind: Any, unit: str | None) -> Any:
    if isinstance(value, Mapping):
        return {k: _with_units(v, *_below(kind, k)) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_with_units(v, *_below(kind, i)) for i, v in enumerate(value)]
    return value if unit is None else f"{value!r} {unit}"


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace(
        "\x7f", "\\u007f"
    )  # TOML wants DEL escaped, JSON does not
