"""The memory of a drive's control law, handed to it once: a call then neither allocates nor converts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from joint_firmware.laws import signals
from joint_firmware.laws.drive_law import DriveLaw


def _view(array: np.ndarray) -> memoryview[float]:
    """``array``'s memory, whose items read and write several times faster than the array's."""
    return memoryview(array)  # type: ignore[arg-type, return-value]  # the stubs know bytes only


class LawMemory:
    """Arguments and results of a law, compiled by ``compile``: arrays, and views of them for single items.

    ``evaluate()`` computes ``x_next`` and ``y`` from ``counts``, ``x``, ``u``, ``p``; to step is the caller's.
    """

    def __init__(self, law: DriveLaw, compile: Callable[[ca.Function], ca.Function]) -> None:
        self._function = function = compile(law.function)
        states = len(law.states)
        self.counts_array = np.zeros(signals.COUNTS_SIZE)
        self.x_array = np.zeros(states)
        self.u_array = np.zeros(signals.INPUT_SIZE)
        self.p_array = np.zeros(len(law.parameters))
        self.x_next_array = np.zeros(states)
        self.y_array = np.zeros(signals.OUTPUT_SIZE)
        self._buffer, self.evaluate = function.buffer()
        for index, array in enumerate((self.counts_array, self.x_array, self.u_array, self.p_array)):
            # a memoryview brings its size along; the stubs ask for it
            self._buffer.set_arg(index, _view(array))  # type: ignore[call-arg, arg-type]
        for index, array in enumerate((self.x_next_array, self.y_array)):
            self._buffer.set_res(index, _view(array))  # type: ignore[call-arg, arg-type]
        self.x, self.x_next = _view(self.x_array), _view(self.x_next_array)
        self.u, self.y = _view(self.u_array), _view(self.y_array)

    def bind(self, function: ca.Function, result: np.ndarray) -> Callable[[], None]:
        """A call of ``function``, which takes what the law takes, into ``result``."""
        buffer, evaluate = function.buffer()
        for index, array in enumerate((self.counts_array, self.x_array, self.u_array, self.p_array)):
            buffer.set_arg(index, _view(array))  # type: ignore[call-arg, arg-type]
        buffer.set_res(0, _view(result))  # type: ignore[call-arg, arg-type]

        def call() -> None:
            evaluate()

        call.memory = buffer, result  # type: ignore[attr-defined]  # CasADi keeps addresses only
        return call

    def restart(self) -> None:
        """Forget the state; commands and parameters stay."""
        self.x_array[:] = 0.0

    def clear(self) -> None:
        """As after power-on; parameters stay."""
        self.x_array[:] = self.u_array[:] = self.y_array[:] = 0.0

    def snapshot(self) -> dict[str, Any]:
        return {"x": self.x_array.copy(), "u": self.u_array.copy(), "y": self.y_array.copy()}

    def restore(self, state: dict[str, Any]) -> None:
        self.x_array[:], self.u_array[:], self.y_array[:] = state["x"], state["u"], state["y"]
