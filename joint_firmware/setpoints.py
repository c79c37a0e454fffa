"""What a drive's law is asked for, written where the law reads it: set-points, weights of the modes, gains."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bus import messages
from bus.messages import GainSet, Mode
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as law

_SLOT = struct.Struct("<" + messages.SLOT_LAYOUT)
_INPUT = struct.Struct(f"<{law.INPUT_SIZE}d")  # in the order of ``laws.signals``
_NEWTON_METRE, _RADIAN = messages.NEWTON_METRE, messages.RADIAN  # a constant of another module is slow to look up
_RADIAN_PER_SECOND, _TORQUE_LIMIT = messages.RADIAN_PER_SECOND, messages.TORQUE_LIMIT
_NO_LIMIT = 1e9  # N m: the set-point's own limit where none comes with it
_MODE_INPUTS = {
    Mode.TORQUE: law.U_TORQUE_MODE, Mode.POSITION: law.U_POSITION_MODE, Mode.DAMPING: law.U_DAMPING_MODE,
    Mode.OPEN_LOOP: law.U_OPEN_LOOP_MODE, Mode.MOTOR_POSITION: law.U_MOTOR_POSITION_MODE,
    Mode.JOINT_POSITION: law.U_JOINT_POSITION_MODE, Mode.IMPEDANCE: law.U_IMPEDANCE_MODE,
}  # fmt: skip
MODES = frozenset({Mode.NONE, *_MODE_INPUTS})
_BEFORE_GAINS = range(law.U_TORQUE_MODE, law.U_KP)  # where the weights of modes lie among the inputs
_BEHIND_GAINS = range(law.U_KD + 1, law.INPUT_SIZE)
Weights = tuple[tuple[float, ...], tuple[float, ...]]  # the inputs before the gains, and those behind them


def _weights(*inputs: int) -> Weights:
    """One at ``inputs``, zero elsewhere."""
    before, behind = (tuple(float(n in inputs) for n in place) for place in (_BEFORE_GAINS, _BEHIND_GAINS))
    return before, behind


_OFF, _STOPPING, _IDLE = _weights(), _weights(law.U_DAMPING_MODE), _weights(law.U_ENABLED)
_ENABLED = {mode: _weights(number, law.U_ENABLED) for mode, number in _MODE_INPUTS.items()}


class Order(NamedTuple):
    """A drive's slot of a command frame, in counts."""

    controlword: int
    mode: int
    gain_set: int
    torque: int
    position: int
    velocity: int
    limit: int
    state_counter: int


class Setpoints:
    """The input ``u`` of one drive's law; ``slot``: which of a command frame is the drive's."""

    def __init__(self, u: np.ndarray, slot: int) -> None:
        self._bytes = memoryview(u).cast("B")  # type: ignore[arg-type]  # numpy's stubs have no buffer before 3.12
        self._u: memoryview[float] = memoryview(u)  # type: ignore[arg-type, assignment]
        self._offset = struct.calcsize("<" + messages.COMMAND_HEADER_LAYOUT) + slot * _SLOT.size
        self._gains: dict[int, tuple[float, float, float]] = {}
        # inputs behind the set-points, by what commands and drive's states there were
        self._followed: dict[tuple[int, int, bool, bool], tuple[float, ...]] = {}

    def configure(self, config: FirmwareConfig, ranges: Mapping[str, float]) -> None:
        """Gains by their sets, and from ``ranges`` [SI] what a set-point may be."""
        sets = {GainSet.STANCE: config.stance, GainSet.SWING: config.swing}
        self._gains = {index: (g.kp, g.ki, g.kd) for index, g in sets.items()}
        self._followed.clear()
        self._torque = int(ranges["torque_range"] / messages.NEWTON_METRE)
        self._position = int(ranges["position_range"] / messages.RADIAN)
        self._velocity = int(ranges["velocity_range"] / messages.RADIAN_PER_SECOND)

    def read(self, data: bytes) -> tuple[int, ...]:
        """The fields of ``Order`` from a command frame's bytes."""
        return _SLOT.unpack_from(data, self._offset)

    def sensible(self, order: tuple[int, ...]) -> bool:
        """Whether set-points are in range. The least integer, which stands for no number, never is."""
        _, _, _, torque, position, velocity, _, _ = order
        return (
            -self._torque <= torque <= self._torque
            and -self._position <= position <= self._position
            and -self._velocity <= velocity <= self._velocity
        )

    def follow(self, order: tuple[int, ...], enabled: bool, stopping: bool) -> None:
        """Everything anew, from a command frame to a drive in this state."""
        _, mode, gain_set, torque, position, velocity, limit, _ = order
        key = (mode, gain_set, enabled, stopping)
        rest = self._followed.get(key)
        if rest is None:
            before, behind = weights(mode, enabled, stopping)
            rest = self._followed[key] = (*before, *self.gains(gain_set), *behind)
        _INPUT.pack_into(
            self._bytes, 0,
            torque * _NEWTON_METRE, position * _RADIAN, velocity * _RADIAN_PER_SECOND, limit * _TORQUE_LIMIT, *rest,
        )  # fmt: skip

    def rest(self, position: float, gain_set: int) -> None:
        """Set-points that move nothing, of a motor at ``position`` [rad]; the modes' weights stay."""
        u = self._u
        u[law.U_TORQUE] = u[law.U_VELOCITY] = 0.0
        u[law.U_POSITION] = position
        u[law.U_LIMIT] = _NO_LIMIT
        self.use_gains(gain_set)

    def target(self, torque: float | None = None, position: float | None = None) -> None:
        """Change a set-point [N m, rad]."""
        if torque is not None:
            self._u[law.U_TORQUE] = torque
        if position is not None:
            self._u[law.U_POSITION] = position

    def weigh(self, weights: Weights) -> None:
        """What runs."""
        u = self._u
        for place, values in zip((_BEFORE_GAINS, _BEHIND_GAINS), weights, strict=True):
            for n, value in zip(place, values, strict=True):
                u[n] = value

    def gains(self, gain_set: int) -> tuple[float, float, float]:
        return self._gains.get(gain_set) or self._gains[GainSet.STANCE]

    def use_gains(self, gain_set: int) -> None:
        u = self._u
        u[law.U_KP], u[law.U_KI], u[law.U_KD] = self.gains(gain_set)


def weights(mode: int, enabled: bool, stopping: bool) -> Weights:
    """Of the modes: the drive's state decides first what runs, the commanded mode second."""
    if enabled:
        return _ENABLED.get(mode, _IDLE)
    return _STOPPING if stopping else _OFF
