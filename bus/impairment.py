"""What an impaired link does to one delivery."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from bus.config import Impairment


class ImpairmentModel:
    """Draws the fate of each delivery. Every kind of fault has its own random stream, and draws only while
    its parameter is above zero: injecting one fault leaves the draws of the others as they were."""

    def __init__(self, name: str, config: Impairment, streams: Callable[[str], Any]) -> None:
        self._values = {key: getattr(config, key) for key in Impairment.model_fields}
        self._streams = {kind: streams(f"{name}.{kind}") for kind in ("jitter", "loss", "bit_error")}
        self._apply()

    def _apply(self) -> None:
        self._delay_ns = round(self._values["delay"] * 1e9)
        self._jitter_ns = self._values["jitter"] * 1e9
        self._loss = self._values["loss"]
        self._bit_error_rate = self._values["bit_error_rate"]
        self.clean = not any(self._values.values())

    def set(self, key: str, value: float) -> None:
        """Change ``delay`` or ``jitter`` [s], ``loss`` or ``bit_error_rate`` [1].

        Raises KeyError for another key and ValueError for a value out of range.
        """
        if key not in self._values:
            raise KeyError(f"no impairment {key!r}; there is {', '.join(self._values)}")
        if not (math.isfinite(value) and value >= 0 and (key in ("delay", "jitter") or value <= 1)):
            raise ValueError(f"{value!r} is out of range for {key}")
        self._values[key] = value
        self._apply()

    def lost(self) -> bool:
        """Whether this delivery vanishes."""
        return self._loss > 0 and self._streams["loss"].uniform() < self._loss

    def extra_ns(self) -> int:
        """Delay of this delivery, ns."""
        if self._jitter_ns > 0:
            return self._delay_ns + int(self._streams["jitter"].uniform() * self._jitter_ns)
        return self._delay_ns

    def damaged_at(self, bits: int) -> int | None:
        """Which of ``bits`` bits is the first to flip, None if none: geometric in the bit error rate."""
        if self._bit_error_rate <= 0:
            return None
        if self._bit_error_rate >= 1:
            return 0
        draw = self._streams["bit_error"].uniform()
        bit = math.log1p(-draw) / math.log1p(-self._bit_error_rate)  # may be infinite
        return int(bit) if bit < bits else None

    def snapshot(self) -> dict[str, Any]:
        return {"values": dict(self._values), "streams": {k: s.snapshot() for k, s in self._streams.items()}}

    def restore(self, state: dict[str, Any]) -> None:
        self._values = dict(state["values"])
        for kind, saved in state["streams"].items():
            self._streams[kind].restore(saved)
        self._apply()
