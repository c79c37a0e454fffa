"""Margins: the largest value of a quantity with which a scenario is stable, by bisection, for each of several seeds.

Where the two ends of the search are not given, they are found by doubling the distance from the nominal value. What is
stable further out, beyond a value that is not, is not looked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from hil.errors import UserError
from hil.lab.experiment import Trials
from hil.lab.kept import Pair
from hil.lab.quantity import Quantity
from hil.lab.statistics import finite, median, median_interval
from hil.lab.workers import parallel
from hil.scenario import Scenario

# First step from a nominal value of 0, by unit; from another it is a quarter of that.
_SCALES = {"s": 1e-3, "ppm": 100.0, "rad": 0.01, "m": 1e-3, "": 0.01}
_DOUBLINGS = 20
_SHRINK = 8.0
_SHRINKS = 8
_FINENESS = 64  # without a resolution: the distance from the nominal value over this
_SHOWN = ("com_error_max", "internal_force_error", "foot_slip_max", "friction_used_max")


@dataclass(frozen=True)
class Search:
    """What to bisect.

    near: the end that ought to be stable; None: the nominal value. far: the other end, above or below it; None: to be
    found, upwards. at: when an injectable quantity changes, s.
    """

    scenario: Scenario
    quantity: Quantity
    at: float
    near: float | None = None
    far: float | None = None
    resolution: float | None = None

    @property
    def start(self) -> float:
        return float(self.quantity.nominal) if self.near is None else self.near

    @property
    def bound(self) -> float:
        """How far a search upwards goes: to the key's bound, and no time beyond the end of the run."""
        high = self.quantity.high
        if self.quantity.unit == "s":
            high = min(high, self.scenario.duration - (self.at if self.quantity.injectable else 0.0))
        return min(high, self.start + self.step * 2.0**_DOUBLINGS)

    @property
    def step(self) -> float:
        nominal = abs(float(self.quantity.nominal))
        first = nominal / 4 if nominal else _SCALES.get(self.quantity.unit, 1.0)
        return max(1.0, round(first)) if self.quantity.kind == "integer" else first

    def outwards(self) -> Iterator[float]:
        """Values to try one after the other: the far end, or in steps that double up to the bound."""
        if self.far is not None:
            yield self.far
            return
        distance, bound = self.step, self.bound
        while (value := self.start + distance) < bound:
            yield _rounded(self, value)
            distance *= 2.0
        if bound > self.start:
            yield bound


@dataclass(frozen=True)
class Tried:
    """One run: the value, its verdict, some of its metrics, and what came first if it failed."""

    value: float
    stable: bool
    reason: str
    metrics: dict[str, Any]
    came_first: str = ""


@dataclass(frozen=True)
class SeedMargin:
    """stable: the largest value found stable, None if the first was not. unstable: the smallest found unstable beyond
    it, None if there was none to the end of the range or to the bound."""

    seed: int
    stable: float | None
    unstable: float | None
    tried: tuple[Tried, ...]


def margin_of_seed(search: Search, seed: int) -> SeedMargin:
    """Bisect for one seed; the settled part is simulated once."""
    with Trials(search.scenario, search.at) as trials:

        def attempt(value: float) -> Tried:
            found = trials.outcome({search.quantity: value}, seed)
            metrics: dict[str, Any] = {name: found.metrics.get(name) for name in _SHOWN}
            metrics["oscillation"] = found.metrics.get("oscillation")
            return Tried(value, found.stable, found.reason, metrics, found.came_first)

        return bisect(search, seed, attempt)


def bisect(search: Search, seed: int, attempt: Callable[[float], Tried]) -> SeedMargin:
    """The search itself."""
    tried: list[Tried] = []

    def stable(value: float) -> bool:
        tried.append(attempt(search.quantity.checked(value)))
        return tried[-1].stable

    low, high = search.start, search.far
    if not stable(low):
        return SeedMargin(seed, None, low, tuple(tried))
    if high is not None:
        if stable(high):
            return SeedMargin(seed, high, None, tuple(tried))
    else:
        for value in search.outwards():
            if not stable(value):
                high = value
                break
            low = value
        if high is None:
            return SeedMargin(seed, low, None, tuple(tried))
        if low == search.start:  # the first step was too far
            for _ in range(_SHRINKS):
                nearer = _rounded(search, low + (high - low) / _SHRINK)
                if not low < nearer < high:
                    break
                if stable(nearer):
                    low = nearer
                    break
                high = nearer
    while abs(high - low) > _resolution(search, high):
        middle = _rounded(search, 0.5 * (low + high))
        if not min(low, high) < middle < max(low, high):
            break  # nothing lies between them that could be written
        if stable(middle):
            low = middle
        else:
            high = middle
    return SeedMargin(seed, low, high, tuple(tried))


def _resolution(search: Search, high: float) -> float:
    fine = abs(high - search.start) / _FINENESS if search.resolution is None else search.resolution
    return max(fine, 1.0) if search.quantity.kind == "integer" else fine * (1 + 1e-9)


def _rounded(search: Search, value: float) -> float:
    """A value that is short to write: on the grid of the resolution, or of four digits."""
    if search.quantity.kind == "integer":
        return round(value)
    if search.resolution is not None:
        value = round(value / search.resolution) * search.resolution
        return float(f"{value:.12g}")
    return float(f"{value:.4g}")


def margins(
    search: Search, seeds: Sequence[int], jobs: int, done: Callable[[int], None] = lambda _: None
) -> list[SeedMargin]:
    """One search per seed, ``jobs`` at a time, in the order of ``seeds``; ``done`` is told how many have ended."""
    found = {}
    for margin in parallel(margin_of_seed, [(search, seed) for seed in seeds], jobs):
        found[margin.seed] = margin
        done(len(found))
    return [found[seed] for seed in seeds]


def summary(search: Search, found: Sequence[SeedMargin]) -> dict[str, Any]:
    """All of it for JSON, in SI units.

    Where a seed was stable to the end of the search its margin counts as infinite, where it was unstable from the start
    as minus infinity. A result that is infinite is None: ``open`` and ``unstable_at_start`` count such seeds.
    """
    quantity = search.quantity
    sign = -1.0 if search.far is not None and search.far < search.start else 1.0
    values = [_as_number(m, sign) for m in found]
    middle = sign * median([sign * value for value in values])  # of two in the middle the nearer
    interval = median_interval(values)
    nowhere = sum(m.stable is None for m in found)
    opens = [m for m in found if m.stable is not None and m.unstable is None]
    return {
        "scenario": search.scenario.name,
        "of": quantity.key,
        "unit": quantity.unit,
        "nominal": quantity.nominal,
        "at": search.at if quantity.injectable else None,
        "resolution": search.resolution,
        "margin": finite(middle),
        "interval": {
            "low": finite(interval.low),
            "high": finite(interval.high),
            "confidence": interval.confidence,
            "method": "order statistics of the seeds, for their median",
        },
        "stable_to": max((m.stable for m in opens if m.stable is not None), default=None),
        "open": len(opens),
        "unstable_at_start": nowhere,
        "per_seed": [asdict(m) for m in found],
        "configuration": search.scenario.model_dump(mode="json"),
    }


def boundary_pair(result: Mapping[str, Any], quantity: Quantity) -> Pair | None:
    """The last stable and the first unstable run of the seed whose margin is the median one, from a ``summary``; of any
    other that has both, if that one has not; None if none has."""
    both = [s for s in result["per_seed"] if s["stable"] is not None and s["unstable"] is not None]
    if not both:
        return None
    seed = next((s for s in both if s["stable"] == result["margin"]), both[0])
    return Pair(seed["seed"], {quantity: seed["stable"]}, {quantity: seed["unstable"]})


def _as_number(margin: SeedMargin, sign: float) -> float:
    if margin.stable is None:
        return -sign * math.inf
    return sign * math.inf if margin.unstable is None else margin.stable


def checked(search: Search) -> Search:
    """``search``, when its ends fit. Raises UserError."""
    quantity = search.quantity
    if not quantity.numeric:
        raise UserError(f"--of {quantity.key}: has no margin, it is no number")
    ends = [end for end in (search.near, search.far) if end is not None]
    for end in ends:
        quantity.checked(end)
    if len(ends) == 2 and ends[0] == ends[1]:
        raise UserError(f"--range: from {quantity.shown(ends[0])} to itself there is nothing to bisect")
    if search.resolution is not None and search.resolution <= 0:
        raise UserError("--resolution: expected more than 0")
    if quantity.injectable and not search.at < search.scenario.duration:
        raise UserError(f"--at {search.at:g} s: the scenario ends at {search.scenario.duration:g} s")
    return replace(search)
