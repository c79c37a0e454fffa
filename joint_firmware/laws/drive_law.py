"""The law of a drive, one CasADi function: what is emulated here is what a DSP would run.

    sensing → monitor → reference → torque loop → saturation and rounding

Torque loops work in the actuator's equivalent rotary coordinates, commands and reports are of the joint
(``robots.actuators``). Sizes are fixed; integers are exact in doubles.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from bus.messages import AMPERE, MOTOR_RADIAN_PER_SECOND, NEWTON_METRE, RADIAN, RADIAN_PER_SECOND
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as s
from joint_firmware.laws.block import Block, Offsets, Symbols, clip, symbols, vector
from joint_firmware.laws.catalogue import TORQUE_LOOPS
from joint_firmware.laws.load_cell import LoadCellSensing, has_load_cell
from joint_firmware.laws.monitor import Monitor
from joint_firmware.laws.output import Output
from joint_firmware.laws.reference import Reference
from joint_firmware.laws.sensing import Direct, Sensing, ThroughLinkage
from robots import pins
from robots.description import Joint
from robots.linkage import Linkage

_I32, _I16 = 2**31 - 1, 2**15 - 1


class Scales(Block):
    """Between the pins and the power stage."""

    parameters = ("ampere_per_count",)

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        return {"ampere_per_count": joint.actuator.ampere_per_count}


class DriveLaw:
    """The law with the torque loop ``loop`` and the velocity estimator ``estimator``.

    ``function`` is ``(counts, x, u, p) -> (x_next, y)``; counts, u and y as in ``laws.signals``, x and p in the
    order of ``states`` and ``parameters``.
    """

    def __init__(
        self,
        loop: str = "PID_m",
        estimator: str = "filter",
        linkage: Linkage | None = None,
        load_cell: bool = False,
    ) -> None:
        self._map = Direct() if linkage is None else ThroughLinkage(linkage)
        self._sensing = (LoadCellSensing if load_cell else Sensing)(estimator, self._map)
        self._monitor = Monitor()
        self._reference, self._output = Reference(self._map), Output(TORQUE_LOOPS[loop])
        self._blocks: tuple[Block, ...] = (
            self._sensing, self._monitor, self._reference, self._output, Scales()
        )  # fmt: skip
        self.states = tuple(name for block in self._blocks for name in block.states)
        self.parameters = tuple(dict.fromkeys(name for block in self._blocks for name in block.parameters))
        if len(set(self.states)) < len(self.states):
            raise AssertionError(f"two blocks have a state of the same name: {self.states}")
        self.function = self._assemble()

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets = Offsets()) -> np.ndarray:
        """The parameter vector of ``joint``'s drive."""
        values: dict[str, float] = {}
        for block in self._blocks:
            values.update(block.values(joint, config, offsets))
        return np.array([values[name] for name in self.parameters])

    def _assemble(self) -> ca.Function:
        counts, u_given = ca.SX.sym("counts", s.COUNTS_SIZE), ca.SX.sym("u", s.INPUT_SIZE)
        x, p = symbols(self.states), symbols(self.parameters)
        sensed, sensing_next = self._sensing.sense(counts, x, p)
        u, misled = self._monitor.admit(u_given, p)
        verdict, monitor_next = self._monitor.watch(counts, u, misled, sensed, x, p)
        wanted, reference_next = self._reference.follow(u, sensed, x, p)
        demand, output_next = self._output.drive(u, sensed, wanted, verdict, x, p)
        x_next = Symbols(**vars(sensing_next), **vars(monitor_next), **vars(reference_next), **vars(output_next))
        y = ca.vertcat(
            _round(sensed.position / RADIAN, _I32),
            _round(sensed.velocity / RADIAN_PER_SECOND, _I32),
            _round(sensed.torque / NEWTON_METRE, _I32),
            _round(counts[pins.CURRENT_ADC] * p.ampere_per_count / AMPERE, _I16),
            _round(sensed.motor_velocity / MOTOR_RADIAN_PER_SECOND, _I16),
            _round(demand.current / p.ampere_per_count, _I32),
            wanted.active * ca.logic_or(wanted.limited, demand.cut),
            sensed.torque,
            sensed.position,
            verdict.trips,
            self._map.to_joint(sensed.motor_position),
        )
        arguments = [counts, vector(x, self.states), u_given, vector(p, self.parameters)]
        names = ["counts", "x", "u", "p"]
        self.levels = ca.Function("levels", arguments, [verdict.levels], names, ["levels"])
        return ca.Function("joint_law", arguments, [vector(x_next, self.states), y], names, ["x_next", "y"])


def _round(value: ca.SX, limit: int) -> ca.SX:
    """``value`` rounded, within ±``limit``: a wild sensor must not overflow a field of the message."""
    return clip(ca.floor(value + 0.5), -limit, limit)


_drive_law = cache(DriveLaw)


def drive_law(joint: Joint, config: FirmwareConfig) -> DriveLaw:
    """The law of ``joint``'s drive; joints whose laws differ by parameters only share one.

    Raises ValueError, with one sentence, for gains that make its torque loop unstable by the loop's own theory.
    """
    doubts(joint, config)
    return _drive_law(config.law, config.velocity_estimator, joint.actuator.linkage, has_load_cell(joint))


def doubts(joint: Joint, config: FirmwareConfig) -> list[str]:
    """A sentence for each condition of the torque loop that its gains do not meet; raises as ``drive_law``."""
    loop, found = TORQUE_LOOPS[config.law], []
    if loop.hydraulic != has_load_cell(joint):
        made_for = "a hydraulic joint" if loop.hydraulic else "a motor behind a spring"
        found.append(f"{joint.name}: firmware.law = {config.law!r} is made for {made_for}, not for this actuator")
    return found + loop.doubts(joint, config)
