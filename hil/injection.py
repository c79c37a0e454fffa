"""What can be changed while a run goes on, and how a change is applied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from bus.config import Impairment


class Impaired(Protocol):
    """A wire or a link: takes a new value of one of its impairments."""

    def set(self, key: str, value: float) -> None: ...


def injectable(bus_names: Sequence[str]) -> list[str]:
    """All keys that can be injected, for a robot with these buses."""
    targets = ["link.state", "link.command", *(f"bus.{name}" for name in bus_names)]
    return [f"{target}.{key}" for target in targets for key in Impairment.model_fields]
