"""Every fault of a drive's protection: how it is brought about, and in what time the drive's output must be safe.

From this table come the tests, ``hil protection`` and the table in docs/protection.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bus.drive_faults import EMERGENCIES, DriveFault
from joint_firmware.protection import REACTIONS, Reaction

_MS = 1e-3


@dataclass(frozen=True)
class FaultCase:
    """One way to a fault.

    ``key`` = ``value`` is injected, the key behind ``joint.NAME.`` unless it begins with ``node.``, which is one of the
    joint's node on its bus. Where nothing that can be injected leads to the fault within a second, ``limits`` of the
    drive are set to below what is there, as a master may (0x2040; ``soft_stop_below``: rad by which the upper soft
    stop, 0x607D:2, is put below the joint), or those that would come before it to above. ``within``: s, from then to
    the first interrupt with a safe output, for the left knee; ``moving``: the sensor must have something to show
    first, at the 0.1 rad/s of a standing robot that sways, or with a current of a fifth of its limit.
    """

    fault: DriveFault
    within: float
    key: str = ""
    value: Any = None
    limits: Mapping[str, float] = field(default_factory=dict)
    moving: bool = False

    @property
    def name(self) -> str:
        cause = f"{self.key.removeprefix('node.')}-{self.value}" if self.key else "-".join(self.limits)
        return f"{self.fault.name.lower()}-{cause}"

    def injection(self, bus: str, joint: str) -> str:
        """The whole key."""
        return f"bus.{bus}.node.{joint}.{self.key[5:]}" if self.key.startswith("node.") else f"joint.{joint}.{self.key}"

    @property
    def cause(self) -> str:
        """As the table has it."""
        causes = [f"`{name}` = {value:g}" for name, value in self.limits.items()]
        if self.key:
            path = "bus.BUS.node.JOINT" if self.key.startswith("node.") else "joint.JOINT"
            causes.insert(0, f"`{path}.{self.key.removeprefix('node.')}` `{_written(self.value)}`")
        return ", ".join(causes)


def _written(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _encoder(fault: DriveFault, key: str) -> Iterator[FaultCase]:
    for kind in ("jump", "noisy", "dead"):
        yield FaultCase(fault, 2 * _MS, key, kind)
    yield FaultCase(fault, 300 * _MS, key, "stuck", moving=True)


CASES: tuple[FaultCase, ...] = (
    *_encoder(DriveFault.MOTOR_ENCODER, "encoder"),
    *_encoder(DriveFault.SPRING_ENCODER, "spring_encoder"),
    *_encoder(DriveFault.JOINT_ENCODER, "joint_encoder"),
    FaultCase(DriveFault.ENCODER_MISMATCH, 1.0, "encoder", "slip", moving=True),
    FaultCase(DriveFault.CURRENT_SENSOR, 200 * _MS, "current_sensor", "dead", moving=True),
    FaultCase(DriveFault.SPRING, 100 * _MS, "spring", 0.0),
    FaultCase(DriveFault.UNDER_VOLTAGE, 6 * _MS, "supply", 0.7),
    FaultCase(DriveFault.OVER_VOLTAGE, 2 * _MS, "supply", 1.3),
    FaultCase(DriveFault.OVER_CURRENT, 2 * _MS, "current_sensor", "jump"),
    FaultCase(DriveFault.OVER_TORQUE, 120 * _MS, "load", "-600 N m"),
    FaultCase(DriveFault.OVER_TORQUE, 1 * _MS, limits={"over_torque": 0.05}),
    FaultCase(DriveFault.OVER_SPEED, 100 * _MS, limits={"over_speed": 0.003, "over_speed_time": 0.005}, moving=True),
    FaultCase(DriveFault.POSITION_LIMIT, 1 * _MS, limits={"soft_stop_below": 0.5}),
    FaultCase(DriveFault.OVER_TEMPERATURE, 12 * _MS, "heating", "140 K"),
    FaultCase(
        DriveFault.OVERLOAD,
        100 * _MS,
        "current_sensor",
        "jump",
        limits={"over_current": 10.0, "current_error": 10.0, "spring_error": 10.0, "overload": 0.001},
    ),
    FaultCase(DriveFault.COMMAND, 5 * _MS, "command", "not_a_number"),
    FaultCase(DriveFault.COMMAND, 5 * _MS, "command", "out_of_range"),
    FaultCase(DriveFault.TIME_OVERRUN, 2 * _MS, "isr_time", "350 us"),
    FaultCase(DriveFault.WATCHDOG, 6 * _MS, "node.cut", True),
)

_WORDS = {Reaction.POWER_OFF: "power off", Reaction.BRAKE: "brakes, then power off"}


def rows() -> list[tuple[str, ...]]:
    """The table: fault, brought about by, reaction, code, error register, time to safe output."""
    found: list[tuple[str, ...]] = [("fault", "brought about by", "reaction", "EMCY", "register", "safe within")]
    for case in CASES:
        emergency = EMERGENCIES[case.fault]
        time = f"{1e3 * case.within:g} ms{' of motion' if case.moving else ''}"
        found.append((
            case.fault.name.lower().replace("_", " "), case.cause, _WORDS[REACTIONS[case.fault]],
            f"0x{emergency.code:04X}", f"0x{emergency.registers:02X}", time,
        ))  # fmt: skip
    return found


def markdown() -> str:
    """The table for the documentation."""
    head, *body = rows()
    lines = [head, tuple("---" for _ in head), *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
