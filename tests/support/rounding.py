"""How far a law in single precision can be from the same law in double precision: running error analysis.

Each number is carried as what double precision computes and a bound of how far single precision is from it. Higham,
Accuracy and Stability of Numerical Algorithms (2002), §3.3: an operation's bound is what its operands' errors make of
it, plus half a unit of the last of 24 bits of a result that large. A comparison whose operands are closer than
their bounds may come out either way, and everything behind it is bounded for both ways; so is a rounding to a
whole number near a border. Nothing is assumed about how errors cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from joint_firmware.export.c99 import PRECISIONS
from joint_firmware.export.operations import Program

UNIT = 2.0**-24  # relative, of rounding to the nearest single
_SMALLEST = 2.0**-149  # absolute, of results below the normal range
_SLACK = 1.0 + 1e-6  # for double's own rounding, here and in the law


class Bounded(NamedTuple):
    """What double precision computes, and how far single precision is from it at most; both of one shape."""

    value: np.ndarray
    error: np.ndarray


def rounded(value: np.ndarray, error: np.ndarray | float = 0.0) -> Bounded:
    """A result of ``value``, exact but for ``error``, when it is rounded to single precision.

    Without error both precisions compute from the same numbers, and single precision gives what double's result rounds
    to (Figueroa 1995: 53 bits are enough for that): whole numbers, as modes are, stay exact.
    """
    bound = (error + UNIT * (np.abs(value) + error) + _SMALLEST) * _SLACK
    return Bounded(value, np.where(error == 0, stored(value).error, bound))


def stored(value: np.ndarray) -> Bounded:
    """A number that is given in double precision and rounded once; whole ones up to 2^24 are exact."""
    return Bounded(value, np.abs(value - value.astype(np.float32).astype(np.float64)))


def _within(value: np.ndarray, low: np.ndarray, high: np.ndarray) -> Bounded:
    """A result that is picked, not computed, between ``low`` and ``high``."""
    return Bounded(value, np.maximum(high - value, value - low))


def _operation(operation: int, a: Bounded, b: Bounded) -> Bounded:
    error = a.error + b.error
    if operation == ca.OP_TWICE:
        return Bounded(2 * a.value, 2 * a.error)  # exact
    if operation == ca.OP_SQ:
        operation, b = ca.OP_MUL, a
    if operation == ca.OP_INV:
        operation, a, b = ca.OP_DIV, Bounded(np.ones(1), np.zeros(1)), a
    if operation == ca.OP_ADD:
        return rounded(a.value + b.value, error)
    if operation == ca.OP_SUB:
        return rounded(a.value - b.value, error)
    if operation == ca.OP_MUL:
        product = np.abs(a.value) * b.error + np.abs(b.value) * a.error + a.error * b.error
        return rounded(a.value * b.value, product)
    if operation == ca.OP_DIV:
        left = np.abs(b.value) - b.error
        assert (left > 0).all()
        return rounded(a.value / b.value, (a.error + np.abs(a.value / b.value) * b.error) / left)
    if operation == ca.OP_NEG:
        return Bounded(-a.value, a.error)
    if operation == ca.OP_FABS:
        return Bounded(np.abs(a.value), a.error)
    if operation in (ca.OP_FMIN, ca.OP_FMAX):
        pick = np.fmin if operation == ca.OP_FMIN else np.fmax
        low, high = (pick(a.value + sign * a.error, b.value + sign * b.error) for sign in (-_SLACK, _SLACK))
        return _within(pick(a.value, b.value), low, high)
    if operation == ca.OP_FLOOR:
        return _within(np.floor(a.value), np.floor(a.value - a.error), np.floor(a.value + a.error))
    if operation == ca.OP_IF_ELSE_ZERO:
        value = np.where(a.value != 0, b.value, 0.0)
        either = np.abs(b.value) + b.error
        return Bounded(value, np.where(a.error > 0, either, np.where(a.value != 0, b.error, 0.0)))
    unsure = (np.abs(a.value - b.value) <= error) & (error > 0)
    if operation == ca.OP_LT:
        return Bounded((a.value < b.value) * 1.0, unsure * 1.0)
    if operation == ca.OP_LE:
        return Bounded((a.value <= b.value) * 1.0, unsure * 1.0)
    if operation in (ca.OP_NE, ca.OP_EQ):
        return Bounded(((a.value == b.value) == (operation == ca.OP_EQ)) * 1.0, unsure * 1.0)
    unsure = error > 0
    if operation == ca.OP_NOT:
        return Bounded((a.value == 0) * 1.0, (a.error > 0) * 1.0)
    if operation == ca.OP_AND:
        return Bounded(((a.value != 0) & (b.value != 0)) * 1.0, unsure * 1.0)
    if operation == ca.OP_OR:
        return Bounded(((a.value != 0) | (b.value != 0)) * 1.0, unsure * 1.0)
    raise NotImplementedError(f"no bound for CasADi's operation {operation}")


def bounds(program: Program, arguments: Sequence[Bounded]) -> list[Bounded]:
    """Results of ``program``, each (steps, size), for ``arguments``, each (steps, size) or (size)."""
    work: list[Bounded] = [Bounded(np.zeros(1), np.zeros(1))] * program.work_size
    results: list[list[Bounded]] = [[work[0]] * size for size in program.result_sizes]
    literal = PRECISIONS["single"].literal
    for instruction in program.instructions:
        which, element = instruction.place
        if instruction.operation == ca.OP_OUTPUT:
            results[which][element] = work[instruction.work[0]]
        elif instruction.operation == ca.OP_INPUT:
            argument = arguments[which]
            work[instruction.target] = Bounded(argument.value[..., element], argument.error[..., element])
        elif instruction.operation == ca.OP_CONST:
            value = np.array([instruction.value])
            single = np.float64(np.float32(literal(instruction.value).rstrip("f")))
            work[instruction.target] = Bounded(value, np.abs(value - single))
        else:
            operands = [work[n] for n in instruction.work]
            work[instruction.target] = _operation(instruction.operation, operands[0], operands[-1])
    steps = max(len(argument.value) for argument in arguments if argument.value.ndim == 2)

    def table(part: int) -> list[np.ndarray]:
        return [
            np.stack([np.broadcast_to(column[part], steps) for column in result], axis=1) for result in results
        ]

    return [Bounded(value, error) for value, error in zip(table(0), table(1), strict=True)]
