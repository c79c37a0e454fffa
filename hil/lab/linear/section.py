"""What is needed of a loop to linearise it: its states at a section once per period, to be read and displaced."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from hil.lab.linear.delay_model import Array


class Section(Protocol):
    """A sampled loop at a moment that comes back every ``period`` s.

    names: of the states, (n,). sizes: displacements of each that are small for the loop and large for its rounding,
    (n,). A *reading* is whatever ``difference`` can compare.
    """

    names: tuple[str, ...]
    sizes: Array
    period: float

    def advance(self) -> None:
        """Run one period."""

    def read(self) -> Any:
        """The reading at this moment."""

    def displace(self, by: Array) -> None:
        """Start at the section with the states displaced ``by`` (n,), each in its own unit, and all else as it was."""

    def difference(self, first: Any, second: Any) -> Array:
        """States of the first reading less those of the second, (n,)."""


def responses(section: Section, periods: int, scale: float = 1.0) -> Array:
    """Responses (periods, n, n) of the states, rows, to their displacements, columns, both in ``sizes``.

    By central differences of displacements of ``scale`` sizes: errors are of second order in it, and what the section
    itself moves by in the meantime falls out.
    """
    n = len(section.names)
    found = np.empty((periods, n, n))
    for state, step in enumerate(scale * np.diag(section.sizes)):
        ahead, behind = (trajectory(section, by, periods) for by in (step, -step))
        for k, (first, second) in enumerate(zip(ahead, behind, strict=True)):
            found[k, :, state] = section.difference(first, second) / (2.0 * scale * section.sizes)
    return found


def trajectory(section: Section, by: Array, periods: int) -> list[Any]:
    """Readings after each of ``periods`` from the section with the states displaced ``by`` (n,)."""
    section.displace(by)
    readings = []
    for _ in range(periods):
        section.advance()
        readings.append(section.read())
    return readings
