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

    def advance(self) -> Any:
        """Run one period. Returns the reading at its end."""

    def displace(self, state: int, amount: float) -> None:
        """Start at the section with one state displaced by ``amount``, in its own unit, and all else as it was."""

    def difference(self, first: Any, second: Any) -> Array:
        """States of the first reading less those of the second, (n,)."""


def responses(section: Section, periods: int, scale: float = 1.0) -> Array:
    """Responses (periods, n, n) of the states, rows, to their displacements, columns, both in ``sizes``.

    By central differences of displacements of ``scale`` sizes: errors are of second order in it, and what the section
    itself moves by in the meantime falls out.
    """
    n = len(section.names)
    found = np.empty((periods, n, n))
    for state, size in enumerate(section.sizes):
        readings = []
        for sign in (1.0, -1.0):
            section.displace(state, sign * scale * size)
            readings.append([section.advance() for _ in range(periods)])
        for k, (ahead, behind) in enumerate(zip(*readings, strict=True)):
            found[k, :, state] = section.difference(ahead, behind) / (2.0 * scale * section.sizes)
    return found
