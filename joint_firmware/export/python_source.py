"""A control law as plain Python: what the same arithmetic costs without CasADi, and a second opinion on its numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from joint_firmware.export.operations import OPERATIONS, Program

_HELPERS = """\
def _less(a, b):  # as C's fmin: a number wins over NaN
    return a if a < b or b != b else b


def _more(a, b):
    return a if a > b or b != b else b


"""


def python_source(program: Program, arguments: Sequence[str], results: Sequence[str]) -> str:
    """Source of ``law(*arguments, *results)``: reads sequences of float, writes into sequences of float.

    Unlike C it raises for a division by zero.
    """
    lines = [f"def law({', '.join([*arguments, *results])}):"]
    for instruction in program.instructions:
        operation, operands = instruction.operation, [f"w{n}" for n in instruction.work]
        which, element = instruction.place
        if operation == ca.OP_OUTPUT:
            lines.append(f"    {results[which]}[{element}] = {operands[0]}")
            continue
        if operation == ca.OP_INPUT:
            value = f"{arguments[which]}[{element}]"
        elif operation == ca.OP_CONST:
            value = repr(instruction.value) if math.isfinite(instruction.value) else f'float("{instruction.value}")'
        else:
            value = OPERATIONS[operation].python.format(*operands)
        lines.append(f"    w{instruction.target} = {value}")
    return _HELPERS + "\n".join(lines) + "\n"


def python_function(program: Program, arguments: Sequence[str], results: Sequence[str]) -> Callable[..., None]:
    """``python_source`` as a callable."""
    space: dict[str, Any] = {"m": math}
    exec(compile(python_source(program, arguments, results), "<control law>", "exec"), space)
    return space["law"]
