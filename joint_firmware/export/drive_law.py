"""What is exported of a drive: its law's function, and a name for every number that goes in or out.

The only module of the export that knows how the firmware builds its law.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from joint_firmware import laws
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.glossary import Quantity, quantity
from joint_firmware.export.operations import Program, program
from joint_firmware.laws import signals
from robots import pins
from robots.description import Joint


class ExportedLaw(NamedTuple):
    """The law of one drive.

    ``function(counts, x, u, p) -> (x_next, y)``; ``counts`` … ``outputs`` describe these vectors item by item,
    ``values`` is p of this joint, ``gains`` says what of u a gain set fills in.
    """

    name: str
    function: ca.Function
    program: Program
    counts: tuple[Quantity, ...]
    state: tuple[Quantity, ...]
    input: tuple[Quantity, ...]
    parameters: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    values: np.ndarray
    gains: dict[str, dict[str, float]]


def exported_law(joint: Joint, config: FirmwareConfig) -> ExportedLaw:
    """The law of ``joint``'s drive. Raises ValueError as ``laws.drive_law``."""
    config = config.of_joint(joint.name)
    law = laws.drive_law(joint, config)
    sets = {"stance": config.stance, "swing": config.swing}
    return ExportedLaw(
        name=config.law,
        function=law.function,
        program=program(law.function),
        counts=_quantities("counts", _numbered(pins, "", pins.N_INPUTS)),
        state=_quantities("x", law.states),
        input=_quantities("u", _numbered(signals, "U_", signals.INPUT_SIZE)),
        parameters=_quantities("p", law.parameters),
        outputs=_quantities("y", _numbered(signals, "Y_", signals.OUTPUT_SIZE)),
        values=law.values(joint, config),
        gains={key: {"kp": g.kp, "ki": g.ki, "kd": g.kd} for key, g in sets.items()},
    )


def _quantities(vector: str, names: Iterable[str]) -> tuple[Quantity, ...]:
    return tuple(quantity(vector, name) for name in names)


def _numbered(module: Any, prefix: str, size: int) -> list[str]:
    """Names of the constants 0 … ``size`` − 1 that ``module`` defines with ``prefix``, in order of definition."""
    named = {
        name.removeprefix(prefix).lower(): value
        for name, value in vars(module).items()
        if name.isupper() and name.startswith(prefix) and type(value) is int
    }
    names = list(named)
    first = names.index(next(name for name in names if named[name] == 0))
    found = names[first : first + size]
    assert [named[name] for name in found] == list(range(size)), (module.__name__, found)
    return found
