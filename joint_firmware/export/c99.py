"""A drive's control law as C99 for its processor: no allocation, no loop over data, libm at most.

The text is made from the law's list of operations, one statement each: what CasADi executes in the emulation, in the
same order.
"""

from __future__ import annotations

import math
import string
from collections.abc import Sequence
from importlib import metadata, resources
from typing import NamedTuple

import casadi as ca
import numpy as np

from joint_firmware.config import FirmwareConfig
from joint_firmware.export.drive_law import ExportedLaw, exported_law
from joint_firmware.export.glossary import Quantity
from joint_firmware.export.operations import KINDS, LIBM, OPERATIONS, ROUNDING, SIGN, Instruction, Program
from robots.description import Robot

_WIDTH = 116
_LARGEST_EXACT = 2**24  # whole numbers up to this one are exact in single precision


class Precision(NamedTuple):
    """Arithmetic of the exported law: C's type, suffix of libm's functions and of constants, bytes, decimal digits that
    tell all numbers apart."""

    name: str
    real: str
    suffix: str
    size: int
    digits: int

    def literal(self, value: float) -> str:
        """``value`` as a constant of C: the nearest number, but in single precision a whole one beyond 2^24 is rounded
        towards zero, so that what is bounded to an integer's range stays in it."""
        if math.isnan(value):
            return "NAN"
        if math.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        if not self.suffix:
            return repr(value)
        single = np.float32(value)
        if value.is_integer() and abs(value) > _LARGEST_EXACT and abs(float(single)) > abs(value):
            single = np.nextafter(single, np.float32(0))
        text = str(single)
        return f"{text}{self.suffix}"


PRECISIONS = {
    "double": Precision("double", "double", "", 8, 17),
    "single": Precision("single", "float", "f", 4, 9),
}

_HELPERS = {
    ca.OP_FMIN: ("smaller", "<", "fmin"),
    ca.OP_FMAX: ("larger", ">", "fmax"),
}
_EXACT = {"ceil", "fabs", "floor", "sqrt"}  # every libm returns the same bits
_VECTORS = ("COUNT", "X", "U", "P")  # prefixes of the names of the function's arguments


class _Template(string.Template):
    delimiter = "@"


def export(robot: Robot, joints: Sequence[str], precision: str, config: FirmwareConfig) -> dict[str, str]:
    """The files of the export: name → text. Equal arguments give equal texts.

    Args:
        joints: names of those of ``robot`` that get a table of parameters.
        precision: a name of PRECISIONS.

    Raises ValueError when the joints' laws differ in more than their parameters, and as ``laws.drive_law`` does.
    """
    laws = {name: exported_law(robot.joint(name), config) for name in joints}
    return source_files(robot, laws, precision, config.rate)


def source_files(robot: Robot, laws: dict[str, ExportedLaw], precision: str, rate: float) -> dict[str, str]:
    """As ``export``, of ``laws`` by joint, stepped at ``rate`` [Hz]."""
    (first, law), *others = laws.items()
    for name, other in others:
        if other.program != law.program:
            raise ValueError(f"the laws of {first} and {name} differ in more than parameters: export each by itself")
    return _Export(robot, law, laws, PRECISIONS[precision], rate).files()


class _Export:
    def __init__(
        self, robot: Robot, law: ExportedLaw, laws: dict[str, ExportedLaw], precision: Precision, rate: float
    ) -> None:
        self.law, self.laws, self.precision = law, laws, precision
        self.tables = {joint: f"{robot.name}_{joint}" for joint in laws}
        joints = "all joints" if len(laws) == len(robot.joints) > 1 else ", ".join(laws)
        version = metadata.version("hume-hil")
        self.origin = [
            f"Robot {robot.name}, {joints}; law {law.name}, {precision.name} precision, {rate:g} Hz.",
            f"Written by hume-hil {version} (hil export), law {law.program.fingerprint}; changes here will be lost.",
        ]
        self.words = {
            "origin": "\n".join(f" * {line}" for line in self.origin),
            "law": law.name, "version": version, "fingerprint": law.program.fingerprint,
            "rate": f"{rate:g}", "real": precision.real, "digits": str(precision.digits),
            "what": f"{robot.name}: {joints}",
        }  # fmt: skip

    def files(self) -> dict[str, str]:
        return {
            "joint_law.h": self._header(),
            "joint_law.c": self._source(),
            **{f"{table}.c": self._table(joint, table) for joint, table in self.tables.items()},
            "main.c": self._main(),
            "Makefile": self._fill(
                "Makefile", origin_make="\n".join(f"# {line}" for line in self.origin), tables=self._table_files()
            ),
            "README.md": self._readme(),
        }

    def _fill(self, template: str, **words: str) -> str:
        text = resources.files("joint_firmware.export").joinpath("templates", template).read_text(encoding="utf-8")
        return _Template(text).substitute(self.words, **words)

    def _table_files(self) -> str:
        return " ".join(f"{table}.c" for table in self.tables.values())

    # --- joint_law.h -----------------------------------------------------------------------------------------

    def _header(self) -> str:
        law, size = self.law, self.precision.size
        groups = (
            ("COUNT", "COUNTS", law.counts, "Input pins, as the electronics counts them."),
            ("X", "STATES", law.state, "State x."),
            ("U", "INPUTS", law.input, "Inputs u."),
            ("P", "PARAMETERS", law.parameters, "Parameters p of a joint."),
            ("Y", "OUTPUTS", law.outputs, "Outputs y; whole numbers fit into an int32_t."),
        )  # fmt: skip
        gains = next(iter(law.gains.values()))
        gain_quantities = [q for q in law.input if q.name in gains]
        exact = {
            "double": "bit for bit those of the emulation",
            "single": "bit for bit the same on\n * every processor with IEEE 754 arithmetic",
        }[self.precision.name]
        alike = {f"{name}{self.precision.suffix}" for name in _EXACT}
        inexact = [name for name in _library(law.program, self.precision) if name not in alike]
        if inexact:
            exact += f",\n * as far as its {', '.join(inexact)} round alike"
        counted = [f" *     {n:4d} {KINDS[kind]}" for kind, n in law.program.counted.items() if n]
        return self._fill(
            "joint_law.h",
            first_table=next(iter(self.tables.values())),
            first_gains=f"{next(iter(self.tables.values()))}_{next(iter(law.gains))}",
            operations="\n".join(counted),
            state_bytes=str(size * (len(law.state) + len(law.input) + len(law.outputs))),
            parameter_bytes=str(size * len(law.parameters)),
            work_bytes=str(size * (len(law.state) + law.program.work_size)),
            libm=", ".join(_library(law.program, self.precision)) or "nothing",
            exactness=exact,
            enumerations="\n\n".join(_enumeration(*group) for group in groups),
            gain_fields="\n".join(f"    joint_law_real {q.name}; /* {_described(q)} */" for q in gain_quantities),
            tables="\n".join(
                f"extern const joint_law_real {table}[JOINT_LAW_PARAMETERS];\n"
                f"extern const joint_law_gains {', '.join(f'{table}_{key}' for key in law.gains)};"
                for table in self.tables.values()
            ),
        )

    # --- joint_law.c -----------------------------------------------------------------------------------------

    def _source(self) -> str:
        law = self.law
        helpers = [_helper(*words) for operation, words in _HELPERS.items() if law.program.uses(operation)]
        names = list(next(iter(law.gains.values())))
        return self._fill(
            "joint_law.c",
            helpers="".join(helpers),
            use_gains="\n".join(f"    law->u[JOINT_LAW_U_{name.upper()}] = gains->{name};" for name in names),
            work=_declarations(law.program.work_size),
            statements="\n".join(self._statement(instruction) for instruction in law.program.instructions),
        )

    def _statement(self, instruction: Instruction) -> str:
        law, operation = self.law, instruction.operation
        operands = [f"w{n}" for n in instruction.work]
        which, element = instruction.place
        if operation == ca.OP_OUTPUT:
            if which == 0:
                return f"    next[JOINT_LAW_X_{law.state[element].name.upper()}] = {operands[0]};"
            return f"    y[JOINT_LAW_Y_{law.outputs[element].name.upper()}] = {operands[0]};"
        if operation == ca.OP_INPUT:
            quantity = (law.counts, law.state, law.input, law.parameters)[which][element]
            vector = ("(joint_law_real)counts", "x", "u", "p")[which]
            value = f"{vector}[JOINT_LAW_{_VECTORS[which]}_{quantity.name.upper()}]"
        elif operation == ca.OP_CONST:
            value = self.precision.literal(instruction.value)
        else:
            one, zero = self.precision.literal(1.0), self.precision.literal(0.0)
            value = OPERATIONS[operation].c.format(*operands, f=self.precision.suffix, one=one, zero=zero)
        return f"    w{instruction.target} = {value};"

    # --- the other files --------------------------------------------------------------------------------------

    def _table(self, joint: str, table: str) -> str:
        law, literal = self.laws[joint], self.precision.literal
        values = [
            f"    {literal(float(value)) + ',':24} /* {quantity.name}: {_described(quantity)} */"
            for value, quantity in zip(law.values, law.parameters, strict=True)
        ]
        sets = [
            f"const joint_law_gains {table}_{key} = {{{', '.join(literal(value) for value in gains.values())}}};"
            for key, gains in law.gains.items()
        ]
        return self._fill("table.c", joint=joint, table=table, values="\n".join(values), gain_sets="\n".join(sets))

    def _main(self) -> str:
        law = self.law
        return self._fill(
            "main.c",
            columns_in=_wrapped(columns_in(law)),
            columns_out=_wrapped(columns_out(law)),
            default_joint=next(iter(self.tables)),
            choices="\n".join(f'    {{"{joint}", {table}}},' for joint, table in self.tables.items()),
        )

    def _readme(self) -> str:
        counted = [f"| {KINDS[kind]} | {n} |" for kind, n in self.law.program.counted.items()]
        rows = [f"| `{table}.c` | parameters and gains of {joint} |" for joint, table in self.tables.items()]
        return self._fill(
            "README.md",
            origin_markdown="\n".join(self.origin),
            table_rows="\n".join(rows),
            table_files=self._table_files(),
            operation_rows="\n".join(counted),
        )


def columns_in(law: ExportedLaw) -> list[str]:
    """What the example reads, per step."""
    return [q.name for q in law.counts] + [f"u.{q.name}" for q in law.input]


def columns_out(law: ExportedLaw) -> list[str]:
    """What the example prints, per step."""
    return [f"y.{q.name}" for q in law.outputs] + [f"x.{q.name}" for q in law.state]


def _wrapped(names: list[str]) -> str:
    lines = [""]
    for name in names:
        if len(lines[-1]) + len(name) > _WIDTH - 10:
            lines.append("")
        lines[-1] += name + ","
    return "\n *     ".join(lines).rstrip(",")


def _described(quantity: Quantity) -> str:
    return f"[{quantity.unit}] {quantity.meaning}" if quantity.unit else quantity.meaning


def _enumeration(prefix: str, total: str, quantities: Sequence[Quantity], title: str) -> str:
    lines = [f"/* {title} */", "enum {"]
    for quantity in quantities:
        lines.append(f"    {f'JOINT_LAW_{prefix}_{quantity.name.upper()},':44} /* {_described(quantity)} */")
    return "\n".join([*lines, f"    JOINT_LAW_{total}", "};"])


def _library(program: Program, precision: Precision) -> list[str]:
    """Functions of libm that the program calls."""
    called = set()
    for instruction in program.instructions:
        operation = OPERATIONS.get(instruction.operation)
        if operation is not None and operation.kind in (LIBM, ROUNDING, SIGN) and "{f}(" in operation.c:
            called.add(operation.c.partition("{f}(")[0] + precision.suffix)
    return sorted(called)


def _helper(name: str, symbol: str, like: str) -> str:
    return (
        f"/* As {like}: a number wins over NaN. */\n"
        f"static inline joint_law_real {name}(joint_law_real a, joint_law_real b)\n"
        f"{{\n    return (a {symbol} b || b != b) ? a : b;\n}}\n\n"
    )


def _declarations(size: int) -> str:
    names = [f"w{n}" for n in range(size)]
    rows = [names[k : k + 16] for k in range(0, size, 16)]
    return "\n".join(f"    joint_law_real {', '.join(row)};" for row in rows)
