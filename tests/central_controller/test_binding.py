"""Functions bound to arrays: results in place, wrong arrays refused, memory kept alive."""

from __future__ import annotations

import gc

import casadi as ca
import numpy as np
import pytest

from central_controller.binding import Bound

_M, _X = ca.SX.sym("M", 2, 3), ca.SX.sym("x", 3)
PRODUCT = ca.Function("product", [_M, _X], [_M @ _X, _M.T], ["M", "x"], ["y", "transposed"])


def test_results_appear_in_place_and_outputs_without_array_are_left_out() -> None:
    M, x, y = np.arange(6.0).reshape(2, 3, order="F"), np.ones(3), np.zeros(2)
    bound = Bound(PRODUCT, {"M": M, "x": x, "other": x}, {"y": y})
    bound()
    assert np.array_equal(y, M @ x)
    x[:], M[0] = [1.0, 2.0, 3.0], 7.0
    bound()
    assert np.array_equal(y, M @ x)
    transposed = np.zeros((3, 2), order="F")
    Bound(PRODUCT, {"M": M, "x": x}, {"transposed": transposed})()
    assert np.array_equal(transposed, M.T)


def test_arrays_that_nobody_else_holds_stay_alive() -> None:
    y = np.zeros(2)
    bound = Bound(PRODUCT, {"M": np.full((2, 3), 2.0, order="F"), "x": np.full(3, 5.0)}, {"y": y})
    gc.collect()
    rubbish = [np.full(6, np.nan) for _ in range(1000)] + [np.full(3, np.nan) for _ in range(1000)]
    bound()
    assert np.array_equal(y, [30.0, 30.0]) and rubbish


@pytest.mark.parametrize(
    "M", [np.zeros((2, 3)), np.zeros((2, 2), order="F"), np.zeros(6, np.float32), np.zeros((3, 3), order="F")]
)
def test_arrays_that_cannot_be_bound_are_refused(M) -> None:
    with pytest.raises(ValueError):
        Bound(PRODUCT, {"M": M, "x": np.zeros(3)}, {})


def test_a_missing_input_is_named() -> None:
    with pytest.raises(KeyError, match="x"):
        Bound(PRODUCT, {"M": np.zeros((2, 3), order="F")}, {})
