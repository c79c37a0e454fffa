"""Blocks on level ground: what the plant builds them from, and what a planner knows of them a priori."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Self

from pydantic import Field, model_validator

from robots.quantities import Config, Metres


class Block(Config):
    """A block across the whole way, e.g. a platform or a beam: from ``start`` to ``end`` along x, in the world."""

    start: Metres
    end: Metres
    height: Annotated[Metres, Field(gt=0, le=1)]

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if self.end <= self.start:
            raise ValueError(f"a block needs its end ({self.end:g} m) behind its start ({self.start:g} m)")
        return self


def ground_height(blocks: Iterable[Block], x: float) -> float:
    """Height of the ground at ``x`` above the level around the blocks [m]."""
    return max((block.height for block in blocks if block.start <= x <= block.end), default=0.0)
