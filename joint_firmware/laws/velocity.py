"""Velocity from an encoder, by the methods that a drive's processor uses; ``firmware.velocity_estimator`` chooses.

    filter   difference of one tick to the next, behind a first-order low-pass
    M        counts in a gate of fixed time
    T        time between two edges
    M/T      counts in a gate that begins and ends with an edge, over the time between these edges

(Ohmae, Matsuda, Kamiyama, Tachikawa, "A microprocessor-controlled high-accuracy wide-range speed regulator for motor
drives", IEEE Trans. Industrial Electronics 29(3), 1982.) No pin captures the time of an edge: the time of T and M/T is
that of the interrupt, T is M/T with a gate of one tick. Without edges their velocity falls as the time since the last
one permits.
"""

from __future__ import annotations

import math

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Block, Symbols, clip, symbols, vector


class VelocityEstimator(Block):
    """Base: of the encoder ``name``, whose states begin with that, and whose smallest step is ``resolution`` [rad]."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.states = tuple(f"{name}_{state}" for state in (*self.own, "velocity"))

    own: tuple[str, ...] = ()

    def settings(self, config: FirmwareConfig) -> dict[str, float]:
        """Values of ``parameters``, which are those of every encoder."""
        raise NotImplementedError

    def estimate(
        self, value: ca.SX, started: ca.SX, resolution: ca.SX, x: Symbols, p: Symbols
    ) -> tuple[ca.SX, dict[str, ca.SX]]:
        """Velocity at ``value`` [rad], and the states of the next tick; ``started`` is 0 where nothing came before."""
        before = [getattr(x, state) for state in self.states]
        after = self._estimate(value, started, resolution, before, p)
        return after[-1], dict(zip(self.states, after, strict=True))

    def _estimate(
        self, value: ca.SX, started: ca.SX, resolution: ca.SX, before: list[ca.SX], p: Symbols
    ) -> list[ca.SX]:
        """The states of the next tick, the velocity last."""
        raise NotImplementedError


class FilteredDifference(VelocityEstimator):
    own = ("position",)
    parameters = ("dt", "velocity_blend")

    def settings(self, config: FirmwareConfig) -> dict[str, float]:
        dt = 1.0 / config.rate
        return {"dt": dt, "velocity_blend": 1.0 - math.exp(-2.0 * math.pi * config.velocity_cutoff * dt)}

    def _estimate(
        self, value: ca.SX, started: ca.SX, resolution: ca.SX, before: list[ca.SX], p: Symbols
    ) -> list[ca.SX]:
        position, velocity = before
        return [value, velocity + started * p.velocity_blend * ((value - position) / p.dt - velocity)]


class Gated(VelocityEstimator):
    """M: the gate opens where the last one closed."""

    own: tuple[str, ...] = ("start", "ticks")
    parameters = ("dt", "velocity_gate")

    def settings(self, config: FirmwareConfig) -> dict[str, float]:
        return {"dt": 1.0 / config.rate, "velocity_gate": max(round(config.velocity_window * config.rate), 1)}

    def _estimate(
        self, value: ca.SX, started: ca.SX, resolution: ca.SX, before: list[ca.SX], p: Symbols
    ) -> list[ca.SX]:
        start, ticks, velocity = before
        ticks = ticks + 1
        closes = ticks >= p.velocity_gate
        velocity = ca.if_else(ca.logic_and(started > 0, closes), (value - start) / (ticks * p.dt), velocity)
        again = ca.logic_or(started == 0, closes)
        return [ca.if_else(again, value, start), ca.if_else(again, 0, ticks), velocity]


class GatedByEdges(Gated):
    """M/T."""

    own = ("before", "start", "ticks")

    def _estimate(
        self, value: ca.SX, started: ca.SX, resolution: ca.SX, before: list[ca.SX], p: Symbols
    ) -> list[ca.SX]:
        last, start, ticks, velocity = before
        ticks = ticks + 1
        closes = ca.logic_and(ticks >= p.velocity_gate, value != last)
        time = ticks * p.dt
        possible = (ca.fabs(value - start) + resolution) / time  # faster, and the next edge would be here
        slowed = ca.if_else(ticks >= p.velocity_gate, clip(velocity, -possible, possible), velocity)
        measured = ca.if_else(closes, (value - start) / time, slowed)
        again = ca.logic_or(started == 0, closes)
        return [
            value,
            ca.if_else(again, value, start),
            ca.if_else(again, 0, ticks),
            ca.if_else(started > 0, measured, velocity),
        ]


class EdgeToEdge(GatedByEdges):
    """T."""

    def settings(self, config: FirmwareConfig) -> dict[str, float]:
        return {**super().settings(config), "velocity_gate": 1.0}


ESTIMATORS: dict[str, type[VelocityEstimator]] = {
    "filter": FilteredDifference, "M": Gated, "T": EdgeToEdge, "M/T": GatedByEdges,
}  # fmt: skip


def estimator_function(name: str) -> ca.Function:
    """The estimator ``name`` alone: ``(value, started, resolution, x, p) -> (x_next, velocity)``.

    ``x`` and ``p`` are its ``states`` and ``parameters``. Raises KeyError for an unknown name.
    """
    estimator = ESTIMATORS[name]("motor")
    x, p = symbols(estimator.states), symbols(estimator.parameters)
    value, started, resolution = (ca.SX.sym(name) for name in ("value", "started", "resolution"))
    velocity, after = estimator.estimate(value, started, resolution, x, p)
    return ca.Function(
        "velocity_estimator",
        [value, started, resolution, vector(x, estimator.states), vector(p, estimator.parameters)],
        [ca.vertcat(*[after[state] for state in estimator.states]), velocity],
        ["value", "started", "resolution", "x", "p"], ["x_next", "velocity"],
    )  # fmt: skip
