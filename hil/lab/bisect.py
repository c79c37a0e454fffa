"""Which of the differences between a stable and an unstable scenario makes it unstable: delta debugging.

``ddmin`` of Zeller and Hildebrandt, Simplifying and Isolating Failure-Inducing Input, IEEE Trans. Softw. Eng. 28(2),
2002, Fig. 3: the set found is 1-minimal, no single member can be left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeVar

from hil.errors import UserError
from hil.lab.quantity import as_written
from hil.record import journal
from hil.scenario import Scenario, complete, from_record, load

_LISTS = ("inject", "push")  # whose entries are differences of their own
_NAMES = ("name", "description")  # which change nothing

T = TypeVar("T")
Result = Literal["stable", "unstable", "unresolved"]


def ddmin(items: Sequence[T], test: Callable[[Sequence[T]], Result]) -> list[T]:
    """A 1-minimal subset of ``items`` that is "unstable"; all of them must be, and none of them "stable"."""
    found, parts = list(items), 2
    while len(found) >= 2:
        size, extra = divmod(len(found), parts)
        starts = [k * size + min(k, extra) for k in range(parts + 1)]
        chunks = [found[low:high] for low, high in pairwise(starts)]
        subset = next((chunk for chunk in chunks if test(chunk) == "unstable"), None)
        if subset is not None:
            found, parts = subset, 2
            continue
        rests = [[item for other in chunks if other is not chunk for item in other] for chunk in chunks]
        rest = next((rest for rest in rests if parts > 2 and test(rest) == "unstable"), None)
        if rest is not None:
            found, parts = rest, max(parts - 1, 2)
        elif parts < len(found):
            parts = min(2 * parts, len(found))
        else:
            break
    return found


@dataclass(frozen=True)
class Side:
    """A scenario with its seed, and where it comes from."""

    scenario: Scenario
    seed: int
    source: str


def side(place: str, settings: Sequence[str], seed: int | None) -> Side:
    """The scenario ``place`` with ``settings``, or the one of the recorded run in the directory ``place``, with what
    was injected into it by hand. Raises UserError."""
    directory = Path(place)
    if not (directory / journal.JOURNAL_FILE).exists():
        return Side(load(place, settings), seed or 0, place)
    if settings:
        raise UserError(f"{place} is the record of a run, which takes no settings")
    head, *entries = journal.read(directory)
    scenario = from_record(head["run"]["configuration"], f"{directory / journal.JOURNAL_FILE}: configuration")
    by_hand = [
        {"at": f"{entry['time_ns']} ns", "key": entry["key"], "value": entry["value"]}
        for entry in entries
        if entry.get("by") == "query"
    ]
    if by_hand:
        data = as_written(scenario)
        data["inject"] = [*data.get("inject", []), *by_hand]
        scenario = complete(data, place)
    return Side(scenario, head["run"]["seed"] if seed is None else seed, place)


@dataclass(frozen=True)
class Change:
    """One difference: what it is called, and how it is made in a scenario's data."""

    name: str
    made: Callable[[dict[str, Any]], None] = field(compare=False)


def changes(stable: Side, unstable: Side) -> list[Change]:
    """All that makes the unstable side out of the stable one."""
    one, other = as_written(stable.scenario), as_written(unstable.scenario)
    found: list[Change] = []
    if stable.seed != unstable.seed:
        found.append(Change(f"seed: {stable.seed} → {unstable.seed}", lambda data: data.update(seed=unstable.seed)))
    for key in _LISTS:
        before, after = one.pop(key, []), other.pop(key, [])
        found += [Change(f"{key} without {_entry(e)}", _without(key, e)) for e in before if e not in after]
        found += [Change(f"{key} with {_entry(e)}", _with(key, e)) for e in after if e not in before]
    _compare((), one, other, found)
    return found


def _compare(path: tuple[str, ...], one: dict[str, Any], other: dict[str, Any], found: list[Change]) -> None:
    for key in dict.fromkeys([*one, *other]):
        before, after = one.get(key), other.get(key)
        if before == after or (not path and key in _NAMES):
            continue
        if isinstance(before, dict) and isinstance(after, dict):
            _compare((*path, key), before, after, found)
        else:
            name = ".".join((*path, key))
            texts = ("nothing" if value is None else str(value) for value in (before, after))
            found.append(Change(f"{name}: {' → '.join(texts)}", _set((*path, key), after)))


def _entry(entry: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in entry.items())


def _without(key: str, entry: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data[key].remove(entry)


def _with(key: str, entry: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data.setdefault(key, []).append(entry)


def _set(path: tuple[str, ...], value: Any) -> Callable[[dict[str, Any]], None]:
    def made(data: dict[str, Any]) -> None:
        for key in path[:-1]:
            data = data.setdefault(key, {})
        if value is None:
            data.pop(path[-1], None)
        else:
            data[path[-1]] = value

    return made


@dataclass(frozen=True)
class Culprit:
    """changes: the minimal set. reason: the verdict with them alone. runs: how many it took. candidates: how many
    differences there are."""

    changes: list[Change]
    reason: str
    runs: int
    candidates: int


def bisect(
    stable: Side,
    unstable: Side,
    told: Callable[[int, int, Result, str], None] = lambda *_: None,
) -> Culprit:
    """The smallest set of differences found that makes ``stable`` unstable.

    Args:
        told: is called after every run with its number, how many differences it had, result and reason.

    Raises UserError when the one is not stable, the other not unstable, or nothing is different.
    """
    from hil.lab.experiment import outcome

    candidates = changes(stable, unstable)
    if not candidates:
        raise UserError(f"{stable.source} and {unstable.source} do not differ in anything that matters")
    base = as_written(stable.scenario)
    results: dict[tuple[str, ...], tuple[Result, str]] = {}

    def test(subset: Sequence[Change]) -> Result:
        name = tuple(change.name for change in subset)
        if name not in results:
            data = deepcopy(base)
            data["seed"] = stable.seed
            for change in subset:
                change.made(data)
            seed = data.pop("seed")
            try:
                scenario = complete(data, "these differences")
                ended = outcome(scenario, seed)
            except UserError as error:  # together they make no scenario
                results[name] = "unresolved", str(error)
            else:
                results[name] = ("stable" if ended.stable else "unstable"), ended.reason
            told(len(results), len(subset), *results[name])
        return results[name][0]

    if test([]) != "stable":
        raise UserError(f"{stable.source} is not stable: {results[()][1]}")
    if test(candidates) != "unstable":
        reason = results[tuple(change.name for change in candidates)][1]
        raise UserError(f"{unstable.source} is not unstable: {reason}")
    found = ddmin(candidates, test)
    return Culprit(found, results[tuple(c.name for c in found)][1], len(results), len(candidates))
