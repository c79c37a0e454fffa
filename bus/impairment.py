"""What an impaired link does to its deliveries: ``ImpairmentModel`` draws their fates, ``Line`` carries them out."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from typing import Any

from bus.config import Impairment

NEVER = 1 << 62  # time of an event that is not foreseen, ns
HELD_NS = 10_000_000  # a delivery held back waits no longer than this for the next one
_PARETO = 3.0  # exponent of the tail: the variance is finite, the third moment is not
_STREAMS = (
    "jitter", "loss", "burst", "burst_loss", "bit_error", "corruption", "corrupted_bit", "duplicate", "reorder",
)  # fmt: skip


class Corrupted(bytes):
    """Data with a bit flipped unnoticed. Nodes do not see the difference; who keeps the score of a run does not take
    it for what was sent."""


def _values(config: Impairment) -> dict[str, Any]:
    """Values by key; those of a table under "table.key"."""
    values: dict[str, Any] = {}
    for key in Impairment.model_fields:
        value = getattr(config, key)
        if key == "burst":
            values |= {f"{key}.{k}": v for k, v in value}
        else:
            values[key] = value
    return values


class ImpairmentModel:
    """Draws the fate of each delivery. Every kind of fault has its own random stream, and draws only while
    its parameter is above zero: injecting one fault leaves the draws of the others as they were."""

    def __init__(self, name: str, config: Impairment, streams: Callable[[str], Any]) -> None:
        self._values = _values(config)
        self._streams = {kind: streams(f"{name}.{kind}") for kind in _STREAMS}
        self._in_burst = False
        self._apply()

    def _apply(self) -> None:
        values = self._values
        self._delay_ns = round(values["delay"] * 1e9)
        self._jitter_ns = values["jitter"] * 1e9
        self._uniform_jitter = values["jitter_shape"] == "uniform"
        self._loss = values["loss"]
        self._bit_error_rate = values["bit_error_rate"]
        self._duplicate = values["duplicate"]
        self._corruption = values["corruption"]
        self.corrupts = self._corruption > 0
        self._reorder = values["reorder"]
        self._enter, self._leave, self._burst_loss = (values[f"burst.{key}"] for key in ("enter", "leave", "loss"))
        if not self._enter:
            self._in_burst = False
        self.clean = not any(values[key] for key in _SWITCHES)

    def set(self, key: str, value: Any) -> None:
        """Change one value, a key of ``bus.config.Impairment`` ("delay", "burst.enter"), in SI units.

        Raises KeyError for another key and ValueError for a value out of range.
        """
        if key not in self._values:
            raise KeyError(f"no impairment {key!r}; there is {', '.join(self._values)}")
        table, _, leaf = key.rpartition(".")
        content = {leaf: f"{value!r} s" if key in ("delay", "jitter") else value}
        try:
            Impairment.model_validate({table: content} if table else content)
        except ValueError:
            raise ValueError(f"{value!r} is out of range for {key}") from None
        self._values[key] = value
        self._apply()

    def lost(self) -> bool:
        """Whether this delivery vanishes, by itself or in a burst."""
        burst = self._enter > 0 and self._lost_in_burst()
        return (self._loss > 0 and self._streams["loss"].uniform() < self._loss) or burst

    def _lost_in_burst(self) -> bool:
        """One step of the Markov chain, then the fate in its state."""
        change = self._leave if self._in_burst else self._enter
        if self._streams["burst"].uniform() < change:
            self._in_burst = not self._in_burst
        return self._in_burst and self._streams["burst_loss"].uniform() < self._burst_loss

    def extra_ns(self) -> int:
        """Delay of this delivery, ns."""
        if self._jitter_ns > 0:
            if self._uniform_jitter:
                return self._delay_ns + int(self._streams["jitter"].uniform() * self._jitter_ns)
            return self._delay_ns + int(self._shaped_jitter() * self._jitter_ns)
        return self._delay_ns

    def _shaped_jitter(self) -> float:
        """Jitter over its parameter, of any shape but the uniform."""
        stream, shape = self._streams["jitter"], self._values["jitter_shape"]
        if shape == "normal":
            return abs(float(stream.normal(1)[0]))
        if shape == "lognormal":
            return math.exp(float(stream.normal(1)[0]) - 0.5)
        if shape == "exponential":
            return -math.log1p(-stream.uniform())
        # Pareto of the second kind (Lomax), whose mean is scale / (exponent - 1)
        return (_PARETO - 1.0) * ((1.0 - stream.uniform()) ** (-1.0 / _PARETO) - 1.0)

    def damaged_at(self, bits: int) -> int | None:
        """Which of ``bits`` bits is the first to flip, None if none: geometric in the bit error rate."""
        if self._bit_error_rate <= 0:
            return None
        if self._bit_error_rate >= 1:
            return 0
        draw = self._streams["bit_error"].uniform()
        bit = math.log1p(-draw) / math.log1p(-self._bit_error_rate)  # may be infinite
        return int(bit) if bit < bits else None

    def duplicated(self) -> bool:
        """Whether this delivery arrives twice."""
        return self._duplicate > 0 and self._streams["duplicate"].uniform() < self._duplicate

    def held_back(self) -> bool:
        """Whether this delivery waits for the next one to overtake it."""
        return self._reorder > 0 and self._streams["reorder"].uniform() < self._reorder

    def corrupted(self, data: bytes) -> bytes:
        """``data`` itself, or with one flipped bit: then of the type Corrupted."""
        if not self.corrupts or self._streams["corruption"].uniform() >= self._corruption or not data:
            return data
        byte, bit = divmod(int(self._streams["corrupted_bit"].uniform() * 8 * len(data)), 8)
        return Corrupted(data[:byte] + bytes([data[byte] ^ 1 << bit]) + data[byte + 1 :])

    def snapshot(self) -> dict[str, Any]:
        return {
            "values": dict(self._values),
            "in_burst": self._in_burst,
            "streams": {k: s.snapshot() for k, s in self._streams.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._values = dict(state["values"])
        for kind, saved in state["streams"].items():
            self._streams[kind].restore(saved)
        self._in_burst = state["in_burst"]
        self._apply()


# Any of these above zero makes a link unclean; the others only shape them.
_SWITCHES = (
    "delay", "jitter", "loss", "burst.enter", "bit_error_rate", "corruption", "duplicate", "reorder",
)  # fmt: skip


class Line:
    """Deliveries under way: each arrives late, out of order, changed, twice or never, as its impairments have it.

    Args:
        impairment: draws the fates.
        changed: an item with its data put through a function; the item itself when that returns the same data.
    """

    def __init__(self, impairment: ImpairmentModel, changed: Callable[[Any, Callable[[bytes], bytes]], Any]) -> None:
        self._impairment = impairment
        self._changed = changed
        self._heap: list[tuple[int, int, Any]] = []  # arrival, sequence, item
        self._sequence = 0
        self._held = 0  # sequence number of the delivery that waits for the next one; 0: none
        self.next_ns = NEVER  # when the next item arrives; NEVER when none is under way
        self.duplicated = 0
        self.corrupted = 0
        self.reordered = 0

    def send(self, now_ns: int, item: Any) -> bool:
        """Put ``item`` on its way. False when it is lost."""
        impairment = self._impairment
        if impairment.lost():
            return False
        copies = 1
        if impairment.duplicated():
            copies = 2
            self.duplicated += 1
        for _ in range(copies):
            arriving = self._changed(item, impairment.corrupted) if impairment.corrupts else item
            if arriving is not item:
                self.corrupted += 1
            arrival = now_ns + impairment.extra_ns()
            if not self._held and impairment.held_back():
                self.put(arrival + HELD_NS, arriving)
                self._held = self._sequence
            else:
                self.put(arrival, arriving)
        return True

    def put(self, arrival: int, item: Any) -> None:
        """Let ``item`` arrive at ``arrival`` ns, as it is."""
        self._sequence += 1
        heapq.heappush(self._heap, (arrival, self._sequence, item))
        if self._held:  # it has waited for this one
            held = next((entry for entry in self._heap if entry[1] == self._held), None)
            self._held = 0
            if held is not None and held[0] > arrival:
                self.reordered += 1
                self._heap.remove(held)
                heapq.heapify(self._heap)
                self._sequence += 1
                heapq.heappush(self._heap, (max(arrival, held[0] - HELD_NS), self._sequence, held[2]))
        self.next_ns = self._heap[0][0]

    def pop_due(self, now_ns: int) -> list[tuple[int, Any]]:
        """(arrival, item) of all that have arrived by ``now_ns``, in order of arrival."""
        due = []
        heap = self._heap
        while heap and heap[0][0] <= now_ns:
            arrival, _, item = heapq.heappop(heap)
            due.append((arrival, item))
        self.next_ns = heap[0][0] if heap else NEVER
        return due

    _COUNTS = ("_sequence", "_held", "next_ns", "duplicated", "corrupted", "reordered")

    def snapshot(self) -> dict[str, Any]:
        return {"heap": list(self._heap), "counts": [getattr(self, name) for name in self._COUNTS]}

    def restore(self, state: dict[str, Any]) -> None:
        self._heap = list(state["heap"])
        for name, value in zip(self._COUNTS, state["counts"], strict=True):
            setattr(self, name, value)
