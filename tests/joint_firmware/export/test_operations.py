"""The list of operations, and what Python and C make of each, against CasADi's own virtual machine."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.commands.bench_joint import exported
from hil.record.law_recording import LawRecording
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.drive_law import ExportedLaw, exported_law
from joint_firmware.export.glossary import Quantity
from joint_firmware.export.operations import KINDS, OPERATIONS, UnsupportedLawError, program
from joint_firmware.export.python_source import python_function
from robots import description
from tests.support.exports import need, same_bits

HUME = description.load("hume")

a, b = ca.SX.sym("a"), ca.SX.sym("b")
# one of each, where both C and Python have a value
EACH = {
    "add": a + b, "sub": a - b, "twice": 2 * a, "mul": a * b, "sq": a * a, "div": a / (1 + b * b),
    "inv": 1 / (1 + b * b), "neg": -a, "fabs": ca.fabs(a), "lt": a < b, "le": a <= b, "eq": ca.eq(a, b),
    "ne": ca.ne(a, b), "not": ca.logic_not(a), "and": ca.logic_and(a, b), "or": ca.logic_or(a, b),
    "if": ca.if_else(a > b, a, 3 * b), "fmin": ca.fmin(a, b), "fmax": ca.fmax(a, b), "floor": ca.floor(a),
    "ceil": ca.ceil(a), "sqrt": ca.sqrt(ca.fabs(a)), "sign": ca.sign(a), "sin": ca.sin(a), "cos": ca.cos(a),
    "tan": ca.tan(a), "asin": ca.asin(a / (1 + ca.fabs(a))), "acos": ca.acos(a / (1 + ca.fabs(a))),
    "atan": ca.atan(a), "atan2": ca.atan2(a, b), "exp": ca.exp(-ca.fabs(a)), "log": ca.log(1 + ca.fabs(a)),
    "tanh": ca.tanh(a), "pow": (1 + ca.fabs(a)) ** (b / (1 + ca.fabs(b))), "constpow": (1 + ca.fabs(a)) ** 0.3,
    "hypot": ca.hypot(a, b),
}  # fmt: skip
ALL = ca.Function("each", [a, b, ca.SX.sym("u", 0), ca.SX.sym("p", 0)], [ca.SX(0, 1), ca.vertcat(*EACH.values())])

BY_LIBM = {  # CasADi may bring another C library than Python's
    "exp", "log", "pow", "constpow", "hypot", "tanh", "sin", "cos", "tan", "asin", "acos", "atan", "atan2",
}  # fmt: skip
ordinary = st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 0.5, 1.0, -2.0, 3.0])


def test_all_operations_are_tried_here() -> None:
    tried = {instruction.operation for instruction in program(ALL).instructions}
    assert set(OPERATIONS) - tried <= {ca.OP_ASSIGN}


@given(ordinary, ordinary)
def test_python_computes_each_operation_as_casadi_does(one: float, other: float) -> None:
    law = python_function(program(ALL), ("a", "b", "u", "p"), ("x", "y"))
    y = [0.0] * len(EACH)
    law([one], [other], [], [], [], y)
    expected = np.array(ALL(one, other, [], [])[1]).ravel()
    for name, ours, theirs in zip(EACH, y, expected, strict=True):
        if name in BY_LIBM:
            assert ours == pytest.approx(theirs, rel=1e-14), name
        elif name in ("fmin", "fmax"):
            assert ours == theirs, name  # of 0 and -0 C's standard allows either: CasADi's own two ways differ
        else:
            assert np.float64(ours).tobytes() == theirs.tobytes(), name


def test_c_computes_each_operation_as_casadi_does() -> None:
    need("cc", "gcc libc6-dev")
    count, state = ca.SX.sym("counts"), ca.SX.sym("x")
    outputs = ca.substitute(ca.vertcat(*EACH.values()), ca.vertcat(a, b), ca.vertcat(0.25 * count, state))
    function = ca.Function("each", [count, state, ca.SX.sym("u"), ca.SX.sym("p")], [0.25 * count - 1, outputs])
    law = ExportedLaw(
        "each", function, program(function), (Quantity("a", "", ""),), (Quantity("b", "", ""),),
        (Quantity("kp", "", ""),), (Quantity("none", "", ""),), tuple(Quantity(f"y_{n}", "", "") for n in EACH),
        np.zeros(1), {"only": {"kp": 0.0}},
    )  # fmt: skip
    rng = np.random.default_rng(5)
    with exported(law) as drive:
        for counts in [*range(-9, 10), *rng.integers(-(2**31), 2**31, 200).tolist()]:
            for x in (0.0, counts * 0.25, float(rng.normal(scale=1e3))):
                drive.x[0] = x
                drive.step(np.array([counts], np.int32))
                expected = [np.array(part).ravel() for part in function(counts, x, 0, 0)]
                assert drive.x[0] == expected[0][0]
                for name, ours, theirs in zip(EACH, drive.y, expected[1], strict=True):
                    assert ours == pytest.approx(theirs, rel=1e-14, abs=0), (name, counts, x)


def test_operations_are_counted_by_kind() -> None:
    p, q = ca.SX.sym("p"), ca.SX.sym("q")
    counted = program(ca.Function("f", [p, q], [ca.fmin(p * q - q / p, ca.floor(p)), ca.sin(p + q)])).counted
    expected = {"additions": 2, "multiplications": 1, "divisions": 1, "selections": 1, "roundings": 1, "functions": 1}
    assert counted == {kind: expected.get(kind, 0) for kind in KINDS}


@pytest.mark.parametrize(
    "function",
    [
        ca.Function("f", [m := ca.MX.sym("m", 2)], [ca.sin(m)]),
        ca.Function("f", [s := ca.SX.sym("s")], [ca.erf(s)]),
    ],
    ids=["MX", "erf"],
)
def test_what_cannot_be_exported_is_refused(function: ca.Function) -> None:
    with pytest.raises(UnsupportedLawError, match="f "):
        program(function)


def test_plain_python_gives_the_numbers_of_the_emulation(recorded: dict[str, LawRecording]) -> None:
    for joint, drive in recorded.items():
        law = python_function(
            exported_law(HUME.joint(joint), FirmwareConfig()).program, ("counts", "x", "u", "p"), ("x_next", "y")
        )
        x, x_next, y, p = drive.x[0].tolist(), [0.0] * drive.x.shape[1], [0.0] * drive.y.shape[1], drive.p.tolist()
        computed = []
        for counts, u in zip(drive.counts.astype(float).tolist(), drive.u.tolist(), strict=True):
            law(counts, x, u, p, x_next, y)
            x, x_next = x_next, x
            computed.append([*y, *x])
        assert same_bits(np.array(computed), np.hstack([drive.y, drive.x_next]))
