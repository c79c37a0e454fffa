"""Limits of a drive's monitors.

What depends on the actuator is a share of what its description says, so that one set fits all joints of a robot. The
fields are the registry: their units, bounds, defaults and descriptions are those of the objects 0x2040 as well.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from robots.quantities import Config, Radians, Seconds

_OFF = 1e6
_Share = Annotated[float, Field(ge=1e-3, le=_OFF)]  # a large one switches a monitor off
_Angle = Annotated[Radians, Field(ge=1e-4, le=_OFF)]
_Time = Annotated[Seconds, Field(ge=0, le=10)]


class ProtectionConfig(Config):
    """When a drive's protection trips (``joint_firmware.laws.monitor``)."""

    # Encoders. Motor, spring and joint encoder are three for two angles: what the motor's says less the deflection is
    # what the joint's says, to the counts (up to 0.2 mrad) whatever moves. Nothing real moves a joint by more than
    # 3 mrad against itself within an interrupt.
    encoder_jump: _Angle = Field(default=0.003, description="step of one encoder against the others in an interrupt")
    # A quarter of the deflection at which a spring of 400 N m/rad carries 8 N m: below what friction hides
    encoder_stuck: _Angle = Field(default=0.005, description="what the others move while one stands still")
    encoder_mismatch: _Angle = Field(default=0.010, description="what motor, spring and joint encoder differ by")
    encoder_time: _Time = Field(default=0.003, description="that an encoder may be stuck, or that they may differ")

    # Currents. The sensor's errors are 1 % of its range; the rest is what a current loop may overshoot.
    over_current: _Share = Field(default=1.25, description="measured current, of the actuator's limit")
    over_current_time: _Time = Field(default=0.001, description="that it may last")
    current_error: _Share = Field(
        default=0.2,
        description="measured less demanded current, of the limit, where the supply has enough voltage for it",
    )
    current_error_time: _Time = Field(default=0.02, description="that it may last")

    over_torque: _Share = Field(default=1.5, description="torque of the spring, of the torque limit")
    # Friction is what the motor's own equation leaves unexplained: up to 9 N m and 10 % of the load of 168 N m
    spring_error: _Share = Field(
        default=0.25,
        description="torque that current, spring and the motor's motion do not explain, of that at the current limit",
    )
    spring_time: _Time = Field(default=0.03, description="that it may last")

    # A motor does not drive itself beyond its no-load speed. Half as much again is what 100 V transistors bear of its
    # back-EMF at 48 V with as much to spare.
    over_speed: _Share = Field(default=1.5, description="speed of the motor, of its no-load speed at nominal supply")
    over_speed_time: _Time = Field(default=0.005, description="that it may last")
    position_margin: _Angle = Field(default=0.2, description="of the joint beyond where its soft stops begin")

    # 36 V and 60 V of 48 V: twelve cells of lithium emptied, and the most that counts as extra-low voltage
    under_voltage: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.75, description="supply, of the actuator's nominal voltage"
    )
    over_voltage: _Share = Field(default=1.25, description="supply, of the actuator's nominal voltage")
    # a DC link sags while the power lasts that it has not; from above, its capacitors do not have the time
    under_voltage_time: _Time = Field(default=0.005, description="that it may last")
    over_voltage_time: _Time = Field(default=0.001, description="that it may last")

    over_temperature: _Share = Field(
        default=1.0, description="rise of the winding over 25 °C, sensed or computed, of what its insulation permits"
    )
    temperature_time: _Time = Field(default=0.01, description="that it may last")
    # From the heat of the continuous current half of the permitted rise is left where the housing is half way
    overload: _Share = Field(
        default=0.5,
        description="rise of the winding by full current (i²t), of what its insulation permits over 25 °C",
    )

    # What no controller asks for that has not lost its mind; the torque limit is for those that have not
    command_range: _Share = Field(
        default=4.0, description="commanded torque, of the torque limit; commanded velocity, of the no-load speed"
    )
    time_budget: _Share = Field(default=0.9, description="time that an interrupt may take, of its period")
    time_overrun_time: _Time = Field(default=0.001, description="that its overruns may last")


# Nothing trips: for a law that is looked at by itself
UNPROTECTED = ProtectionConfig.model_validate({
    name: f"{_OFF:g} rad" if field.json_schema_extra == {"unit": "rad"} else _OFF
    for name, field in ProtectionConfig.model_fields.items()
    if not name.endswith("_time") and name != "under_voltage"
} | {"under_voltage": 0.0})  # fmt: skip
