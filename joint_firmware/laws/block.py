"""A block of a drive's law: an equation with states and parameters of its own, each with a name."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca

from joint_firmware.config import FirmwareConfig
from robots.description import Joint

Symbols = SimpleNamespace  # states or parameters: one scalar ca.SX per name


class Offsets(NamedTuple):
    """Zeros of a joint's encoders, rad: what each reads where it should read 0."""

    motor: float = 0.0
    spring: float = 0.0
    joint: float = 0.0


class Block:
    """Base of the blocks.

    A state belongs to one block. A parameter may be named by several: it is then the same one. ``values`` gives those
    of a joint; its keys are ``parameters``.
    """

    states: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {}


def symbols(names: Iterable[str]) -> Symbols:
    """A scalar symbol for each name."""
    return Symbols(**{name: ca.SX.sym(name) for name in names})


def vector(of: Symbols, names: Iterable[str]) -> ca.SX:
    """The items of ``of`` with these names, in order, as one column."""
    items = [getattr(of, name) for name in names]
    return ca.vertcat(*items) if items else ca.SX(0, 1)


def clip(value: ca.SX, low: ca.SX | float, high: ca.SX | float) -> ca.SX:
    return ca.fmin(ca.fmax(value, low), high)
