"""Two-axis maps from a sweep's table: where it is stable, where it is not, and where its seeds cannot tell.

A place is decided when the interval of Clopper and Pearson for its share of stable runs lies on one side of ½, with a
confidence of 95 % or, of fewer than six seeds, what unanimous seeds can give: 1 − 2^(1−n). The boundary's confidence
band reaches from the last place that is decided on one side to the first one on the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.errors import UserError
from hil.lab.places import Places, places
from hil.lab.quantity import Quantity


@dataclass(frozen=True)
class StabilityMap:
    """Places (n,) by ``x`` and ``y`` in SI units; share of stable runs; decided: 1 stable, −1 not, 0 in doubt.

    shape: rows and columns of a grid, whose places follow each other with x fastest; None for scattered samples.
    reasons: the most frequent one of each place.
    """

    scenario: str
    x_quantity: Quantity
    y_quantity: Quantity
    x_log: bool
    y_log: bool
    x: np.ndarray
    y: np.ndarray
    share: np.ndarray
    runs: np.ndarray
    decided: np.ndarray
    confidence: float
    reasons: tuple[str, ...]
    shape: tuple[int, int] | None

    @property
    def nominal(self) -> tuple[float, float]:
        """The scenario's own values: the operating point of its source."""
        return float(self.x_quantity.nominal), float(self.y_quantity.nominal)


def load_map(
    directory: Path, x: str | None = None, y: str | None = None, where: Mapping[str, str] | None = None
) -> StabilityMap:
    """The map of the sweep in ``directory``.

    Of more than two axes ``x`` and ``y`` say which; ``where`` (values by key, as written) holds the others. Raises
    UserError.
    """
    return map_of(map_places(directory, x, y, where))


def map_places(
    directory: Path, x: str | None = None, y: str | None = None, where: Mapping[str, str] | None = None
) -> Places:
    """The places of such a map: two free axes, x first. Raises UserError."""
    if x is not None and x == y:
        raise UserError(f"--x and --y are both {x}: a map needs two axes")
    wanted = [key for key in (x, y) if key is not None]
    found = places(directory, wanted, where)
    keys = [q.key for q in found.quantities]
    if x is None and y is not None and len(keys) == 2:  # the other one goes to the right
        found = places(directory, keys[::-1], where)
        keys = keys[::-1]
    if len(keys) < 2:
        raise UserError(f"{directory}: a map needs two axes; there is {keys[0] if keys else 'none'} alone")
    if len(keys) > 2:
        held = ", ".join(keys[2:])
        raise UserError(f"{directory}: --where KEY=VALUE has to leave two axes, and hold the others: {held}")
    for q in found.quantities:
        if not q.numeric:
            raise UserError(
                f"{q.key} has no scale to draw a map over; hold it with --where {q.key}=VALUE, "
                "or --x and --y name two that have"
            )
    return found


def map_of(found: Places) -> StabilityMap:
    """The map over two axes, x first."""
    every = list(found.rows)
    x, y = (np.array(values, float) for values in zip(*every, strict=True))
    shape = (len(set(y)), len(set(x)))
    grid = found.grid and shape[0] * shape[1] == len(every)
    (x_quantity, y_quantity), (x_log, y_log) = found.quantities, found.logs
    return StabilityMap(
        found.scenario.name, x_quantity, y_quantity, x_log, y_log, x, y,
        np.array([found.share(place) for place in every]), np.array([len(found.rows[place]) for place in every]),
        np.array([found.decided(place) for place in every]), found.confidence,
        tuple(found.reason(place) for place in every), shape if grid else None,
    )  # fmt: skip
