"""A CasADi function bound to arrays: called without arguments, it reads and writes them in place."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np


class Bound:
    """``function`` with every input and output in a float64 array of its name.

    Raises KeyError for an input without array; outputs without one are not computed. An output must not be in the
    memory of an input: the generated code writes outputs before it has read all inputs.
    """

    def __init__(
        self, function: ca.Function, inputs: Mapping[str, np.ndarray], outputs: Mapping[str, np.ndarray]
    ) -> None:
        buffer, self._evaluate = function.buffer()
        for i, name in enumerate(function.name_in()):
            # casadi's stubs show the C signature (address, size)
            buffer.set_arg(i, _memory(inputs[name], function.sparsity_in(i)))  # type: ignore[call-arg]
        for i, name in enumerate(function.name_out()):
            if name in outputs:
                buffer.set_res(i, _memory(outputs[name], function.sparsity_out(i)))  # type: ignore[call-arg]
        self._alive = (function, buffer, *inputs.values(), *outputs.values())  # the buffer holds bare addresses

    def __call__(self) -> None:
        self._evaluate()


def items(array: np.ndarray) -> memoryview[float]:
    """The array's memory, whose items are read and written several times faster than the array's."""
    return memoryview(array)  # type: ignore[arg-type, return-value]  # the stubs know bytes only


def _memory(array: np.ndarray, sparsity: ca.Sparsity) -> memoryview:
    """The array's memory, column by column as CasADi reads it. Raises ValueError when that is not possible."""
    if array.dtype != np.float64 or not array.flags.f_contiguous:
        raise ValueError("a bound array must be of float64, column-major")
    if not sparsity.is_dense() or array.size != sparsity.numel():
        raise ValueError(f"an array of shape {array.shape} cannot hold a {sparsity.dim()} matrix")
    return array.T.reshape(-1).data
