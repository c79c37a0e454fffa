"""The closed loop at one operating point as a linear map over a period: its modes, and what they are made of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hil.lab.linear.delay_model import Array, DelayModel, memory, recurrence, refined
from hil.lab.linear.section import Section, responses

# What drifts more slowly cannot be told from what stays: feet where they are put, integrals that take seconds. Rounding
# alone moves such modes by some tenths.
_STILL, _WAVE = 1.0, 0.1  # 1/s, Hz
_FLOOR = 5e-4  # of singular values of what passes through the delays, beside 1
_TAIL = 4  # periods at the end in which nothing new can arrive
_ABOVE_NOISE = 1.5
_OSCILLATES, _MATTERS = 0.5, 30.0  # Hz, 1/s
_SHARE = 0.04  # smallest participation worth telling
# Of the displacements' usual sizes, tried one after the other: with stiff tasks these would lift a foot, much smaller
# ones are lost in the rounding of the messages. Either shows as noise.
SCALES = (1.0, 0.5, 0.25, 0.1, 0.05)
_CLEAN = 0.05  # noise with which no other scale is tried
_DOUBTFUL = 1.0  # noise as large as the displacements themselves


@dataclass(frozen=True)
class Mode:
    """eigenvalue: over one period. growth [1/s], frequency [Hz]; shares: participation by what takes part, largest
    first, adding up to 1."""

    eigenvalue: complex
    growth: float
    frequency: float
    shares: tuple[tuple[str, float], ...]

    @property
    def still(self) -> bool:
        """Whether it neither grows nor fades as far as one can tell."""
        return abs(self.growth) < _STILL and self.frequency < _WAVE

    @property
    def damping(self) -> float:
        """Damping ratio."""
        size = math.hypot(self.growth, 2.0 * math.pi * self.frequency)
        return -self.growth / size if size > 0.0 else 0.0

    def told(self, most: int = 4) -> str:
        """Who takes part, in words."""
        return ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.shares[:most] if share >= _SHARE)

    def record(self) -> dict[str, Any]:
        return {
            "eigenvalue": [self.eigenvalue.real, self.eigenvalue.imag],
            "growth": self.growth,
            "frequency": self.frequency,
            "damping": self.damping,
            "still": self.still,
            "participation": {name: share for name, share in self.shares if share >= 0.01},
        }


@dataclass(frozen=True)
class Linearisation:
    """names: of the states. sizes: their units in ``model``. noise: of the identified matrices' entries in these units,
    what rounding and curvature leave. memory: periods for which something is under way. scale: of the displacements."""

    model: DelayModel
    names: tuple[str, ...]
    sizes: Array
    noise: float
    memory: int
    scale: float = 1.0

    @classmethod
    def cleanest(cls, section: Section, delay: float) -> Linearisation:
        """``of`` displacements of that one of ``SCALES`` which leaves least noise: the first that leaves little or,
        where it is bearable, the last before it grows again."""
        best = cls.of(section, delay, SCALES[0])
        for scale in SCALES[1:]:
            if best.noise < _CLEAN:
                break
            found = cls.of(section, delay, scale)
            if found.noise < best.noise:
                best = found
            elif best.noise < _DOUBTFUL:
                break
        return best

    @classmethod
    def of(cls, section: Section, delay: float, scale: float = 1.0) -> Linearisation:
        """From displacements of ``section``'s states, by ``scale`` of its sizes. ``delay``: longest way of data through
        the loop, s."""
        periods = math.ceil(delay / section.period) + 4 + _TAIL
        found = responses(section, periods, scale)
        matrices = recurrence(found)
        noise = float(np.abs(matrices[-_TAIL:]).max())
        matrices = refined(found, matrices, _ABOVE_NOISE * noise)
        model = DelayModel.of(matrices, section.period, _FLOOR)
        return cls(model, section.names, section.sizes, noise, memory(matrices), scale)

    def like(self, mode: Mode) -> Mode:
        """The mode in which the same takes part as in ``mode`` of another linearisation, at about its frequency."""

        def unlikeness(other: Mode) -> float:
            a, b = dict(mode.shares), dict(other.shares)
            common = sum(math.sqrt(share * b.get(name, 0.0)) for name, share in a.items())  # Bhattacharyya's
            return abs(math.log((other.frequency + 0.1) / (mode.frequency + 0.1))) - math.log(max(common, 1e-12))

        return min((other for other in self.modes if not other.still), key=unlikeness)

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """By falling growth; of a pair of conjugates the one above the real axis."""
        values, _, shares = self.model.modes()
        groups = [group(name) for name in self.names] + ["data under way"]
        found = []
        for value, share in zip(values, shares.T, strict=True):
            if value.imag < -1e-12 or abs(value) < 1e-6:
                continue
            total: dict[str, float] = {}
            for name, part in zip(groups, share, strict=True):
                total[name] = total.get(name, 0.0) + float(part)
            exponent = np.log(complex(value)) / self.model.period
            ranked = sorted(total.items(), key=lambda item: -item[1])
            frequency = abs(exponent.imag) / (2.0 * math.pi)
            found.append(Mode(complex(value), float(exponent.real), float(frequency), tuple(ranked)))
        return tuple(found)

    @property
    def dominant(self) -> Mode:
        """The one that fades last, or grows fastest, among those that do."""
        return next(mode for mode in self.modes if not mode.still)

    @property
    def growth(self) -> float:
        """Of the dominant mode, 1/s: the loop is stable when it is negative."""
        return self.dominant.growth

    def doubt(self, half: Linearisation | None = None) -> str | None:
        """Why the modes are not to be trusted, in a sentence; None if they are. ``half``: the same with half of the
        displacements."""
        if self.noise > _DOUBTFUL:
            left = f"a noise of {self.noise:.2g} displacements is left, whatever their size"
            return f"not to be trusted: {left}; a foot may lift, or slip"
        growth = self.growth if half is None else half.like(self.dominant).growth
        if abs(growth - self.growth) > abs(self.growth):
            told = f"half of the displacements make its growth {growth:.2g}/s instead of {self.growth:.2g}/s"
            return f"not to be trusted about the dominant mode: {told}"
        return None

    def shape(self, mode: Mode) -> Array:
        """The states' part of ``mode``'s eigenvector (n,), in the states' units; its size is arbitrary."""
        values, vectors, _ = self.model.modes()
        return vectors[:, int(np.argmin(np.abs(values - mode.eigenvalue)))] * self.sizes

    def change(self, other: Linearisation) -> dict[str, float]:
        """How far the modes that oscillate and matter, or if there is none the dominant one, move from here to
        ``other``, with displacements of another size: largest change [1/s] of growth and of angular frequency."""
        matter = [m for m in self.modes if m.frequency > _OSCILLATES and m.growth > -_MATTERS] or [self.dominant]
        pairs = [(mode, other.like(mode)) for mode in matter]
        return {
            "growth": max(abs(a.growth - b.growth) for a, b in pairs),
            "angular_frequency": max(2.0 * math.pi * abs(a.frequency - b.frequency) for a, b in pairs),
            "noise": self.noise,
            "scale": self.scale,
        }

    def record(self) -> dict[str, Any]:
        """For JSON, in SI units: what the loop is and all its modes."""
        return {
            "states": len(self.names),
            "memory": self.memory,
            "order": len(self.model.matrix),
            "growth": self.growth,
            "dominant": self.dominant.record(),
            "modes": [mode.record() for mode in self.modes],
        }

    @property
    def eigenvalues(self) -> Array:
        return np.array([mode.eigenvalue for mode in self.modes])


def group(name: str) -> str:
    """What a state belongs to: a direction with its speed, a drive's filters, …"""
    if " drive's " in name:
        return name.partition("'s ")[0]
    if name.startswith("controller's velocity"):
        return "controller's velocity filters"
    return name.removesuffix(" speed")
