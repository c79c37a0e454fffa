"""Applies the faults of one node of a bus (``bus.config.NodeFaults``): where each key takes effect."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hil.errors import UserError
from hil.senders import Senders

# Faults of the physical layer, and the wire's method that takes (port, value).
_ON_THE_WIRE = {"cut": "cut", "stuck_dominant": "stuck_dominant", "bit_rate": "bit_rate_error"}


class NodeSetter:
    """Takes the injected values of the node at ``port`` of ``wire``; ``joint``: its number, None for the gateway.

    ticks: how often the joints have ticked so far.
    """

    def __init__(
        self, wire: Any, port: int, joint: int | None, senders: Senders | None, ticks: Callable[[], int] = lambda: 0
    ) -> None:
        self._wire, self._port = wire, port
        self._joint, self._senders, self._ticks = joint, senders, ticks

    def __call__(self, key: str, value: Any, now_ns: int) -> None:
        """Set ``key`` to ``value``. Raises KeyError for a key that this node has not."""
        if key in _ON_THE_WIRE:
            method = getattr(self._wire, _ON_THE_WIRE[key], None)
            if method is None:
                raise UserError(f"this wire has no fault {key!r}")
            method(self._port, value)
        elif self._joint is None or self._senders is None:
            raise KeyError(key)
        elif key == "node_id":
            self._senders.set_node_id(self._joint, value)
        elif key == "drift":
            self._senders.set_drift(self._joint, value, self._ticks())
        else:
            raise KeyError(key)
