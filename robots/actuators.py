"""Descriptions of actuators, by ``kind``: what the plant builds its model from, and what a drive's firmware must know.

Firmware works in equivalent rotary coordinates, those of the joint at the actuator's nominal moment arm r0: effort =
force · r0 [N m], motor coordinate phi = screw displacement / r0 [rad]. A rotary actuator has phi = q, r0 = 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator, Field, InstanceOf, Tag, model_validator

from robots.linkage import Linkage
from robots.pins import AMPERE_PER_COUNT
from robots.quantities import Config

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]

AMBIENT = 25.0  # °C, at which data sheets give resistances
COPPER = 0.00393  # 1/K, by which the resistance of copper grows over that at 25 °C

# Current that liquid cooling lets flow for as long as one likes, over that of air (Kim 2018 §5.3.1). Heat is resistance
# times current squared: the way from the winding to the surroundings has its square less thermal resistance.
LIQUID_CURRENT_RATIO = 3.59


class Thermal(Config):
    """Winding and housing as two thermal masses, as motor makers' data sheets give them."""

    winding_to_housing: Positive  # K/W
    housing_to_ambient: Positive  # K/W
    winding_time_constant: Positive  # s
    housing_time_constant: Positive  # s
    winding_limit: Positive  # °C

    @property
    def winding_capacity(self) -> float:
        """J/K."""
        return self.winding_time_constant / self.winding_to_housing

    @property
    def housing_capacity(self) -> float:
        """J/K."""
        return self.housing_time_constant / self.housing_to_ambient

    def liquid_cooled(self) -> Thermal:
        """The same masses of metal, with the thermal resistances that liquid cooling leaves."""
        share = 1.0 / LIQUID_CURRENT_RATIO**2
        return self.model_copy(update={
            key: share * getattr(self, key)
            for key in ("winding_to_housing", "housing_to_ambient", "winding_time_constant", "housing_time_constant")
        })  # fmt: skip


class Motor(Config):
    """The electrical and thermal side of a brushless motor, as a direct-current motor between two terminals."""

    resistance: Positive  # Ω at 25 °C, terminal to terminal
    thermal: Thermal  # cooled by air


class Actuator(Config):
    """What every actuator says of itself. Derive from it to describe an actuator of your own."""

    kind: str
    current_limit: Positive  # A, of the drive
    ampere_per_count: Positive = AMPERE_PER_COUNT  # of demand and measurement on the pins
    supply_voltage: Positive = 48.0  # V
    linkage: Linkage | None = None

    if TYPE_CHECKING:  # fields of some actuators, derived values of others; in equivalent rotary coordinates

        @property
        def stiffness(self) -> float:
            """Of the compliant element, N m/rad."""

        @property
        def damping(self) -> float:
            """Of the compliant element, N m s/rad."""

        @property
        def rotor_inertia(self) -> float:
            """Of all that moves with the motor, kg m²."""

        @property
        def viscous(self) -> float:
            """Viscous friction of the motor, N m s/rad."""

        @property
        def torque_per_ampere(self) -> float:
            """Effort per ampere of the motor, N m/A, friction apart."""

        @property
        def motor(self) -> Motor | None:
            """Electrical and thermal data; None without an electric motor."""

    @property
    def nominal_arm(self) -> float:
        """r0, m; 1 for a rotary actuator."""
        return 1.0 if self.linkage is None else self.linkage.nominal_arm

    @property
    def thermal(self) -> Thermal | None:
        """Thermal data of the motor as it is cooled; None without an electric motor."""
        return None if self.motor is None else self.motor.thermal


class SeriesElastic(Actuator):
    """A rotary series elastic actuator, seen from the joint; gear_ratio, torque_constant and motor are the motor's."""

    kind: Literal["sea"] = "sea"
    stiffness: Positive  # N m/rad
    damping: NonNegative  # N m s/rad, of the spring
    rotor_inertia: Positive  # kg m², reflected to the joint
    gear_ratio: Positive
    torque_constant: Positive  # N m/A at the motor
    coulomb: NonNegative  # N m at the joint, sliding
    static: NonNegative  # N m at the joint, at rest
    load_friction: NonNegative  # share of the transmitted torque
    viscous: NonNegative  # N m s/rad at the joint
    motor: Motor

    @property
    def torque_per_ampere(self) -> float:
        """Motor torque at the joint per ampere, N m/A, without friction."""
        return self.gear_ratio * self.torque_constant


class Material(Config):
    """A spring material (Kim 2018 Table C.2)."""

    compression_set: NonNegative | None  # share of the length; None: not in the table
    linearity: Positive  # R² of a straight line through force over displacement
    stiffness: Positive  # N/m, linear part
    damping: NonNegative  # N s/m
    creep: NonNegative | None  # share of the force that relaxes; None: not in the table


MATERIALS: Mapping[str, Material] = {
    name: Material(
        compression_set=None if compression_set is None else compression_set / 100,
        linearity=linearity,
        stiffness=1e3 * stiffness,
        damping=damping,
        creep=None if creep is None else creep / 100,
    )
    for name, compression_set, linearity, stiffness, damping, creep in (
        ("spring steel", 0.0, 0.996, 860.8, 0.0, 0.0),
        ("polyurethane 90A", 2.0, 0.992, 8109.0, 16000.0, 15.3),
        ("reinforced silicone 70A", 2.7, 0.978, 57570.0, 242000.0, None),
        ("buna-n 90A", 2.8, 0.975, 11270.0, 29000.0, 25.0),
        ("viton 75A", 4.0, 0.963, 2430.0, 9000.0, 30.14),
        ("polyurethane 80A", 4.5, 0.993, 2266.0, 4000.0, 16.8),
        ("epdm 80A", 6.48, 0.939, 6499.0, 16000.0, 23.4),
        ("silicone 90A", None, 0.983, 12460.0, 37000.0, 10.7),
    )
}


class Elastomer(Config):
    """The viscoelastic element of one actuator. What is not given is that of the material's test piece."""

    material: str
    stiffness: Positive  # N/m, at once
    damping: NonNegative  # N s/m
    creep: Annotated[float, Field(ge=0, lt=1)]  # share of the force that relaxes
    # s, of that relaxation. ASSUMED, as Table C.2 gives shares only: of the order in which rubbers in compression lose
    # most of what they lose, tens of seconds
    creep_time_constant: Positive = 10.0

    @model_validator(mode="before")
    @classmethod
    def _from_table(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or "material" not in data:
            return data
        name = data["material"]
        if name not in MATERIALS:
            raise ValueError(f"no material {name!r}; there is: {', '.join(MATERIALS)}")
        material = MATERIALS[name]
        if material.creep is None and "creep" not in data:
            raise ValueError(f"creep: Kim 2018 Table C.2 has none for {name}: give one, for example 0.15")
        known = {"stiffness": material.stiffness, "damping": material.damping, "creep": material.creep}
        return {**known, **data}


class Viscoelastic(Actuator):
    """The viscoelastic (liquid-cooled) actuator: motor, belt, ball screw, elastomer, linkage (Kim 2018 §5.3.1)."""

    kind: Literal["vlca"]
    motor: Motor
    cooling: Literal["liquid", "air"] = "liquid"
    torque_constant: Positive  # N m/A at the motor, k_τ
    motor_inertia: Positive  # kg m² at the motor, I_m
    motor_friction: NonNegative  # N m s at the motor, b_m
    reduction: Positive  # rad of the motor per m of the screw, N_m
    efficiency: Annotated[float, Field(gt=0, le=1)]  # of belt and screw, η
    moving_mass: Positive  # kg that moves with the elastomer, m_r
    elastomer: Elastomer
    linkage: Linkage
    force_limit: Positive  # N that the mechanics bear
    supply_power: Positive  # W that the supply gives before its voltage falls

    @property
    def thermal(self) -> Thermal:
        return self.motor.thermal if self.cooling == "air" else self.motor.thermal.liquid_cooled()

    @property
    def stiffness(self) -> float:
        """k_r r0², N m/rad."""
        return self.elastomer.stiffness * self.nominal_arm**2

    @property
    def damping(self) -> float:
        """b_r r0², N m s/rad."""
        return self.elastomer.damping * self.nominal_arm**2

    @property
    def rotor_inertia(self) -> float:
        """(I_m N_m² + m_r) r0², kg m² (Kim 2018 (5.11); the rotor's part is that of (5.25))."""
        return (self.motor_inertia * self.reduction**2 + self.moving_mass) * self.nominal_arm**2

    @property
    def viscous(self) -> float:
        """b_m N_m² r0², N m s/rad."""
        return self.motor_friction * (self.reduction * self.nominal_arm) ** 2

    @property
    def torque_per_ampere(self) -> float:
        """η k_τ N_m r0, N m/A."""
        return self.efficiency * self.torque_constant * self.reduction * self.nominal_arm


class Hydraulic(Actuator):
    """A double-acting cylinder behind a servo valve and a load cell (Rotella 2018 §II.1)."""

    kind: Literal["hydraulic"]
    supply_pressure: Positive  # Pa
    return_pressure: NonNegative = 0.0  # Pa
    piston_area: Positive  # m², pushing (cap side)
    rod_area: Positive  # m², pulling (annulus)
    stroke: Positive  # m; the middle is at the linkage's nominal length
    dead_volume: Positive  # m³, of each line and chamber end
    piston_mass: Positive  # kg, with rod and load cell
    bulk_modulus: Positive  # Pa, effective, of oil and hoses
    leakage: NonNegative  # m³/s/Pa across the piston
    valve_flow: Positive  # m³/s at rated current and drop
    valve_drop: Positive  # Pa across one edge at rated flow
    valve_leakage: NonNegative = 0.0  # m³/s/Pa of each edge, centred
    valve_bandwidth: Positive  # Hz at which the spool lags by 90°, small signals
    valve_damping: Positive = 0.9  # ratio, of the spool
    valve_slew: Positive = 1e3  # fastest spool, full openings per s
    valve_deadband: NonNegative = 0.0  # A, overlap
    valve_offset: float = 0.0  # A at which the spool is centred
    coulomb: NonNegative  # N, of the seals, sliding
    static: NonNegative  # N, of the seals, at rest
    viscous_friction: NonNegative  # N s/m
    cell_stiffness: Positive  # N/m, of load cell, rod and bearings
    cell_damping: NonNegative  # N s/m
    linkage: Linkage
    supply_voltage: Positive = 24.0  # V, of the valve's electronics

    @property
    def motor(self) -> None:
        return None

    @property
    def stiffness(self) -> float:
        """That of the oil with both chambers closed at mid-stroke, N m/rad."""
        volumes = [self.dead_volume + 0.5 * self.stroke * area for area in (self.piston_area, self.rod_area)]
        areas = (self.piston_area, self.rod_area)
        linear = self.bulk_modulus * sum(area**2 / volume for area, volume in zip(areas, volumes, strict=True))
        return linear * self.nominal_arm**2

    @property
    def damping(self) -> float:
        """None beside the friction of the seals."""
        return 0.0

    @property
    def rotor_inertia(self) -> float:
        """Of piston and rod, kg m²."""
        return self.piston_mass * self.nominal_arm**2

    @property
    def viscous(self) -> float:
        """Of the seals, N m s/rad."""
        return self.viscous_friction * self.nominal_arm**2

    @property
    def torque_per_ampere(self) -> float:
        """Stalled, full pressure comes with rated current: a scale rather than a law, N m/A."""
        return self.supply_pressure * self.piston_area * self.nominal_arm / self.current_limit


BUILT_IN = ("sea", "vlca", "hydraulic")


def _tag(value: Any) -> str | None:
    if isinstance(value, Mapping):
        kind = value.get("kind", "sea")
        return kind if kind in BUILT_IN else None
    kind = getattr(value, "kind", None)
    return kind if kind in BUILT_IN else "custom"


AnyActuator = Annotated[
    Annotated[SeriesElastic, Tag("sea")]
    | Annotated[Viscoelastic, Tag("vlca")]
    | Annotated[Hydraulic, Tag("hydraulic")]
    | Annotated[InstanceOf[Actuator], Tag("custom")],
    Discriminator(
        _tag,
        custom_error_type="actuator_kind",
        custom_error_message=f"kind: expected one of {', '.join(BUILT_IN)}, or FILE.py:CLASS for one of your own",
    ),
]
