"""How warm the motor is: its sensor, a model of winding and housing, and i²t for what heats faster than a sensor shows.

    C_w dT_w = R (1 + α (T_w − 25 °C)) i² − (T_w − T_h) / R_wh
    C_h dT_h = (T_w − T_h) / R_wh − (T_h − 25 °C) / R_ha

The model takes a step every 0.1 s, with the heat of that time: what a single interrupt adds is less than half the last
bit of a temperature in single precision, and would be lost. The sensor says how warm it is at power-on, in the model as
well. i²t is the integral of i² − i_c², never below zero, with i_c the current that may flow for ever. Its limit is what
the full current adds to it until it has warmed the winding by a share of what its insulation permits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.block import Block, Offsets, Symbols
from robots import pins
from robots.actuators import AMBIENT, COPPER, Actuator
from robots.description import Joint

_STEP_S = 0.1  # of the model; windings take seconds


class Heat(NamedTuple):
    """Both over their limits."""

    temperature: ca.SX
    load: ca.SX


def continuous_current(actuator: Actuator) -> float:
    """Current that heats the winding to its limit in the end, A; at most that of the drive, also without a motor."""
    motor, thermal = actuator.motor, actuator.thermal
    if motor is None or thermal is None:
        return actuator.current_limit
    way = thermal.winding_to_housing + thermal.housing_to_ambient
    rise = thermal.winding_limit - AMBIENT
    return min(math.sqrt(rise / (_hot(motor.resistance, rise) * way)), actuator.current_limit)


def _hot(resistance: float, rise: float) -> float:
    """``resistance`` when ``rise`` K above 25 °C."""
    return resistance * (1.0 + COPPER * rise)


def _overload_limit(actuator: Actuator, rise: float) -> float:
    """Integral of i² − i_c² until the full current has warmed the winding by ``rise`` K, A² s.

    The winding warms towards the housing's temperature and what lies across the way to it; if that is not enough, the
    housing has to warm for the rest.
    """
    motor, thermal = actuator.motor, actuator.thermal
    assert motor is not None and thermal is not None
    power = _hot(motor.resistance, thermal.winding_limit - AMBIENT) * actuator.current_limit**2
    across = power * thermal.winding_to_housing
    if across > rise:
        time = -thermal.winding_time_constant * math.log(1.0 - rise / across)
    else:
        time = thermal.winding_time_constant + thermal.housing_capacity * (rise - across) / power
    return time * max(actuator.current_limit**2 - continuous_current(actuator) ** 2, 0.01 * actuator.current_limit**2)


class HeatWatch(Block):
    states = ("winding_temperature", "housing_temperature", "current_heat", "heat_time", "overload")
    parameters = (
        "dt", "heat_step", "resistance", "winding_rate", "housing_rate", "housing_share", "winding_heat",
        "permitted_rise", "continuous_square", "overload_limit",
    )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        actuator, limits = joint.actuator, config.protection
        motor, thermal = actuator.motor, actuator.thermal
        dt = 1.0 / config.rate
        step = max(_STEP_S - 0.5 * dt, 0.0)
        values = {"dt": dt, "heat_step": step, "continuous_square": continuous_current(actuator) ** 2}
        if motor is None or thermal is None:  # no winding: its temperature stays what the sensor says
            return values | {
                "resistance": 0.0, "winding_heat": 0.0, "winding_rate": 0.0, "housing_rate": 0.0, "housing_share": 0.0,
                "permitted_rise": 1e9, "overload_limit": 1e9,
            }  # fmt: skip
        rise = thermal.winding_limit - AMBIENT
        return values | {
            "overload_limit": _overload_limit(actuator, limits.overload * rise),
            "resistance": motor.resistance,
            "winding_heat": 1.0 / thermal.winding_capacity,  # K/J
            "winding_rate": 1.0 / (thermal.winding_to_housing * thermal.winding_capacity),  # 1/s
            "housing_rate": 1.0 / (thermal.winding_to_housing * thermal.housing_capacity),
            "housing_share": 1.0 / (thermal.housing_to_ambient * thermal.housing_capacity),
            "permitted_rise": limits.over_temperature * rise,
        }

    def watch(self, counts: ca.SX, current: ca.SX, x: Symbols, p: Symbols) -> tuple[Heat, Symbols]:
        """``current`` [A], measured. The levels, and the states of the next tick."""
        sensed = counts[pins.TEMPERATURE_ADC] * pins.KELVIN_PER_COUNT
        winding = ca.if_else(x.started > 0, x.winding_temperature, sensed)
        housing = ca.if_else(x.started > 0, x.housing_temperature, sensed)
        gathered, time = x.current_heat + p.dt * current**2, x.heat_time + p.dt  # A² s, s: since the model's last step
        due = time >= p.heat_step
        heat = due * p.resistance * (1.0 + COPPER * (winding - AMBIENT)) * gathered  # J
        across, h = winding - housing, due * time
        winding_next = winding + p.winding_heat * heat - h * p.winding_rate * across
        housing_next = housing + h * (p.housing_rate * across - p.housing_share * (housing - AMBIENT))
        overload = ca.fmax(x.overload + p.dt * (current**2 - p.continuous_square), 0)
        overload = ca.fmin(overload, 1.1 * p.overload_limit)
        temperature = (ca.fmax(sensed, winding_next) - AMBIENT) / p.permitted_rise
        x_next = Symbols(
            winding_temperature=winding_next, housing_temperature=housing_next, overload=overload,
            current_heat=ca.if_else(due, 0, gathered), heat_time=ca.if_else(due, 0, time),
        )  # fmt: skip
        return Heat(temperature, overload / p.overload_limit), x_next
