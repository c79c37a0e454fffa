"""What a CasADi function does, as the list of elementary operations that its virtual machine executes."""

from __future__ import annotations

import hashlib
from collections import Counter
from typing import NamedTuple

import casadi as ca

ADDITION, MULTIPLICATION, DIVISION = "additions", "multiplications", "divisions"
COMPARISON, SELECTION = "comparisons", "selections"
SIGN, ROUNDING, LIBM = "signs", "roundings", "functions"
KINDS = {
    ADDITION: "additions and subtractions",
    MULTIPLICATION: "multiplications",
    DIVISION: "divisions",
    COMPARISON: "comparisons, logic",
    SELECTION: "selections (smaller, larger, if)",
    SIGN: "negations, magnitudes",
    ROUNDING: "roundings to an integer (libm)",
    LIBM: "other functions of libm",
}


class Operation(NamedTuple):
    """How one operation is counted and written: ``{0}``, ``{1}`` are its operands, ``{f}`` is libm's suffix in C,
    ``{one}`` and ``{zero}`` are constants in C; Python has ``math`` as m and ``_less``, ``_more`` of
    ``python_source``."""

    kind: str
    c: str
    python: str


def _comparison(symbol: str) -> Operation:
    test = f"{{0}} {symbol} {{1}}"
    return Operation(COMPARISON, f"({test}) ? {{one}} : {{zero}}", f"1.0 if {test} else 0.0")


def _libm(name: str, python: str, arity: int = 1) -> Operation:
    operands = ", ".join(f"{{{n}}}" for n in range(arity))
    return Operation(LIBM, f"{name}{{f}}({operands})", f"{python}({operands})")


def _arithmetic(kind: str, expression: str) -> Operation:
    return Operation(kind, expression, expression)


OPERATIONS = {
    ca.OP_ASSIGN: _arithmetic(SELECTION, "{0}"),
    ca.OP_ADD: _arithmetic(ADDITION, "{0} + {1}"),
    ca.OP_SUB: _arithmetic(ADDITION, "{0} - {1}"),
    ca.OP_TWICE: _arithmetic(ADDITION, "{0} + {0}"),
    ca.OP_MUL: _arithmetic(MULTIPLICATION, "{0} * {1}"),
    ca.OP_SQ: _arithmetic(MULTIPLICATION, "{0} * {0}"),
    ca.OP_DIV: _arithmetic(DIVISION, "{0} / {1}"),
    ca.OP_INV: Operation(DIVISION, "{one} / {0}", "1.0 / {0}"),
    ca.OP_NEG: _arithmetic(SIGN, "-{0}"),
    ca.OP_FABS: Operation(SIGN, "fabs{f}({0})", "abs({0})"),
    ca.OP_LT: _comparison("<"),
    ca.OP_LE: _comparison("<="),
    ca.OP_EQ: _comparison("=="),
    ca.OP_NE: _comparison("!="),
    ca.OP_NOT: Operation(COMPARISON, "({0} == {zero}) ? {one} : {zero}", "1.0 if {0} == 0.0 else 0.0"),
    ca.OP_AND: Operation(
        COMPARISON, "({0} != {zero} && {1} != {zero}) ? {one} : {zero}", "1.0 if {0} and {1} else 0.0"
    ),
    ca.OP_OR: Operation(
        COMPARISON, "({0} != {zero} || {1} != {zero}) ? {one} : {zero}", "1.0 if {0} or {1} else 0.0"
    ),
    ca.OP_IF_ELSE_ZERO: Operation(SELECTION, "({0} != {zero}) ? {1} : {zero}", "{1} if {0} else 0.0"),
    ca.OP_FMIN: Operation(SELECTION, "smaller({0}, {1})", "_less({0}, {1})"),
    ca.OP_FMAX: Operation(SELECTION, "larger({0}, {1})", "_more({0}, {1})"),
    ca.OP_FLOOR: Operation(ROUNDING, "floor{f}({0})", "{0} // 1.0"),
    ca.OP_CEIL: Operation(ROUNDING, "ceil{f}({0})", "-(-{0} // 1.0)"),
    ca.OP_SQRT: _libm("sqrt", "m.sqrt"),
    ca.OP_SIN: _libm("sin", "m.sin"),
    ca.OP_COS: _libm("cos", "m.cos"),
    ca.OP_TAN: _libm("tan", "m.tan"),
    ca.OP_ASIN: _libm("asin", "m.asin"),
    ca.OP_ACOS: _libm("acos", "m.acos"),
    ca.OP_ATAN: _libm("atan", "m.atan"),
    ca.OP_ATAN2: _libm("atan2", "m.atan2", 2),
    ca.OP_EXP: _libm("exp", "m.exp"),
    ca.OP_LOG: _libm("log", "m.log"),
    ca.OP_TANH: _libm("tanh", "m.tanh"),
    ca.OP_POW: _libm("pow", "m.pow", 2),
    ca.OP_CONSTPOW: _libm("pow", "m.pow", 2),
    ca.OP_HYPOT: _libm("hypot", "m.hypot", 2),
    ca.OP_SIGN: Operation(
        SELECTION, "({0} < {zero}) ? -{one} : ({0} > {zero}) ? {one} : {0}",
        "-1.0 if {0} < 0.0 else 1.0 if {0} > 0.0 else {0}",
    ),
}  # fmt: skip


class Instruction(NamedTuple):
    """One operation. ``work`` are slots of the work memory that it reads; it writes to slot ``target``.

    Reading an argument: ``operation`` is OP_INPUT and ``place`` = (argument, element). Writing a result: OP_OUTPUT and
    (result, element). A constant: OP_CONST and ``value``.
    """

    operation: int
    work: tuple[int, ...]
    target: int
    place: tuple[int, int] = (0, 0)
    value: float = 0.0


class UnsupportedLawError(ValueError):
    """A function that is not a list of elementary operations on numbers."""


class Program(NamedTuple):
    """A function as a straight list of instructions: no loop, no jump, so every call takes all of them."""

    instructions: tuple[Instruction, ...]
    work_size: int
    argument_sizes: tuple[int, ...]
    result_sizes: tuple[int, ...]

    @property
    def counted(self) -> dict[str, int]:
        """Operations of one call by kind of KINDS, without copies from and to memory."""
        found = Counter(OPERATIONS[i.operation].kind for i in self.instructions if i.operation in OPERATIONS)
        return {kind: found[kind] for kind in KINDS}

    def uses(self, operation: int) -> bool:
        return any(instruction.operation == operation for instruction in self.instructions)

    @property
    def fingerprint(self) -> str:
        """Hexadecimal digest of what is computed: equal ones compute the same."""
        return hashlib.sha256(repr(tuple(self)).encode()).hexdigest()[:16]


def program(function: ca.Function) -> Program:
    """``function`` (made of SX) as a program. Raises UnsupportedLawError for an operation that is not in OPERATIONS."""
    if not function.is_a("SXFunction"):
        raise UnsupportedLawError(f"{function.name()} is a {function.class_name()}: only an SXFunction can be exported")
    return Program(
        tuple(_instruction(function, k) for k in range(function.n_instructions())),
        function.sz_w(),
        tuple(function.nnz_in(i) for i in range(function.n_in())),
        tuple(function.nnz_out(i) for i in range(function.n_out())),
    )


def _instruction(function: ca.Function, k: int) -> Instruction:
    operation = function.instruction_id(k)
    read, written = tuple(function.instruction_input(k)), tuple(function.instruction_output(k))
    if operation == ca.OP_INPUT:
        return Instruction(operation, (), written[0], place=(read[0], read[1]))
    if operation == ca.OP_OUTPUT:
        return Instruction(operation, read, 0, place=(written[0], written[1]))
    if operation == ca.OP_CONST:
        return Instruction(operation, (), written[0], value=function.instruction_constant(k))
    if operation not in OPERATIONS:
        raise UnsupportedLawError(f"{function.name()} has an operation that cannot be exported (CasADi's {operation})")
    return Instruction(operation, read, written[0])
