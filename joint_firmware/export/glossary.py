"""Unit and meaning of every number that goes into a drive's law or comes out: what an export says of them."""

from __future__ import annotations

from typing import NamedTuple

from robots import pins


class Quantity(NamedTuple):
    """One number of a vector: its name, an identifier of C; its unit, "" for a plain number."""

    name: str
    unit: str
    meaning: str


# (unit, meaning) by the name of the function's argument or result, and the name of the number
_GLOSSARY: dict[str, dict[str, tuple[str, str]]] = {
    "counts": {
        "motor_encoder": ("counts", "of the motor's encoder"),
        "spring_encoder": ("counts", "of the spring's deflection"),
        "current_adc": ("counts", "measured current; parameter ampere_per_count"),
        "temperature_adc": (f"{pins.KELVIN_PER_COUNT:g} °C", "of the winding"),
        "supply_adc": (f"{pins.VOLT_PER_COUNT:g} V", "supply voltage"),
        "switches": ("", "bit 0: foot contact"),
        "joint_encoder": ("counts", "of the joint's absolute encoder"),
        "force_adc": ("counts", "of the load cell"),
        "isr_timer": ("us", "that the interrupt before this one took"),
    },
    "x": {
        "started": ("", "0 at the first step: nothing came before"),
        "integral": ("N m", "integral of the torque error"),
        "velocity_integral": ("N m", "integral of the inner loop's velocity error"),
        "observed_low": ("N m", "disturbance observer: filtered effort of the nominal actuator"),
        "observed_rate": ("N m/s", "its rate"),
        "inner_low": ("N m", "disturbance observer: filtered effort of the inner loop"),
        "inner_rate": ("N m/s", "its rate"),
        "torque_low": ("N m", "filtered torque, of which the derivative is taken"),
        "torque_rate": ("N m/s", "its rate"),
        "torque_reference": ("N m", "what was followed at the last step"),
        "active": ("", "1: something was followed at the last step"),
        "closed": ("", "1: the torque loop was closed at the last step"),
        "kp": ("N m/(N m)", "gain at the last step"),
        "ki": ("1/s", "gain at the last step"),
        "kd": ("N m s/rad", "gain at the last step"),
        "carry": ("N m", "what a change of gains or mode would have made the effort jump by; it fades"),
        "regime": ("", "what the motor was for at the last step: 1 a command, 2 damping"),
        "demand": ("N m", "motor effort demanded at the last step"),
        "demanded": ("A", "current demanded at the last step"),
        "ramp": ("N m", "what is left of the demand before the regime changed"),
        "residual": ("rad", "what the three encoders disagree by"),
        "residual_zero": ("rad", "the same at the start"),
        "winding_temperature": ("°C", "by the thermal model"),
        "housing_temperature": ("°C", "by the thermal model"),
        "current_heat": ("A² s", "integral of the current's square since the thermal model's last step"),
        "heat_time": ("s", "since that step"),
        "overload": ("A² s", "integral of the current's square beyond the continuous one's"),
        "current_difference": ("A", "filtered, of measured from demanded current"),
        "momentum": ("N m s", "of the rotor, by the observer of what is not explained"),
    },
    "u": {
        "torque": ("N m", "commanded torque; feed-forward in the position modes"),
        "position": ("rad", "commanded position, of the joint"),
        "velocity": ("rad/s", "commanded velocity, of the joint"),
        "limit": ("N m", "of the torque's size, beside parameter torque_limit"),
        "torque_mode": ("", "1: follow the commanded torque"),
        "position_mode": ("", "1: follow the commanded position with the motor, around the torque loop"),
        "damping_mode": ("", "1: only damp the motor's velocity"),
        "open_loop_mode": ("", "1: the commanded torque is the motor's"),
        "motor_position_mode": ("", "1: follow the commanded position with the motor, without a torque loop"),
        "joint_position_mode": ("", "1: follow the commanded position with the joint, around the torque loop"),
        "impedance_mode": ("", "1: be a spring and a damper at the joint"),
        "enabled": ("", "1: in operation; 0: changes of the demand need not be smooth"),
        "kp": ("N m/(N m)", "motor effort per torque error"),
        "ki": ("1/s", "motor effort per integral of the torque error"),
        "kd": ("N m s/rad", "motor effort per motor velocity"),
    },
    "p": {
        "dt": ("s", "period of the steps: call them at this rate"),
        "rad_per_count": ("rad", "per count of the motor's encoder, signed"),
        "rad_per_spring_count": ("rad", "of deflection per count of the spring's encoder, signed"),
        "rad_per_joint_count": ("rad", "per count of the joint's encoder, signed"),
        "effort_per_count": ("N m", "per count of the load cell, signed"),
        "ampere_per_count": ("A", "per count of the current's sensor and of the demand"),
        "motor_offset": ("rad", "zero of the motor's encoder"),
        "spring_offset": ("rad", "zero of the spring's encoder"),
        "joint_offset": ("rad", "zero of the joint's encoder"),
        "stiffness": ("N m/rad", "of the compliant element"),
        "velocity_blend": ("", "share of the new sample in the velocities' first-order filter"),
        "velocity_gate": ("", "steps in which edges are counted for a velocity, at least"),
        "torque_per_ampere": ("N m/A", "motor effort"),
        "current_limit": ("A", "of the demand"),
        "motor_inertia": ("kg m²", "of the rotor"),
        "rotor_inertia": ("kg m²", "of the rotor"),
        "motor_damping": ("N m s/rad", "of motor and compliant element"),
        "viscous": ("N m s/rad", "friction of the motor"),
        "observer_cutoff": ("rad/s", "of the disturbance observer"),
        "observer_half_step": ("s", "of its filter"),
        "torque_rate_cutoff": ("rad/s", "of the torque's derivative"),
        "torque_rate_half_step": ("s", "of its filter"),
        "velocity_integral_gain": ("1/s", "of the inner velocity loop"),
        "velocity_compensation": ("N m s/rad", "motor effort per velocity of the piston"),
        "valve_bias": ("N m", "motor effort against the valve's mechanical offset"),
        "torque_limit": ("N m", "of the torque that is followed"),
        "torque_step": ("N m", "most that the followed torque changes in a step"),
        "ramp_step": ("N m", "most that the demand changes in a step when the regime changes"),
        "position_low": ("rad", "joint limit, where the soft stop begins"),
        "position_high": ("rad", "joint limit, where the soft stop begins"),
        "soft_stop_stiffness": ("N m/rad", "beyond a joint limit"),
        "quick_stop_damping": ("N m s/rad", "in damping mode"),
        "position_stiffness": ("N m/rad", "in the motor's position modes"),
        "position_damping": ("N m s/rad", "in the motor's position modes"),
        "joint_stiffness": ("N m/rad", "in joint position mode"),
        "joint_damping": ("N m s/rad", "in joint position mode"),
        "impedance_stiffness": ("N m/rad", "in impedance mode"),
        "impedance_damping": ("N m s/rad", "in impedance mode"),
        # protection: limits, and how long they may be exceeded
        "has_spring": ("", "1: the joint has a spring and its encoder"),
        "encoder_jump": ("rad", "by which the encoders may come to disagree within a step"),
        "encoder_stuck": ("rad", "by which they may come to disagree while one stands still"),
        "encoder_mismatch": ("rad", "by which they may disagree"),
        "encoder_time": ("s", "that they may do so"),
        "observer_rate": ("1/s", "of the observer of what accelerates the motor without explanation"),
        "current_blend": ("", "share of the new sample in the filter of measured from demanded current"),
        "current_error": ("A", "of measured from demanded current"),
        "current_error_time": ("s", "that it may be exceeded"),
        "most_current": ("A", "measured"),
        "over_current_time": ("s", "that it may be exceeded"),
        "most_torque": ("N m", "sensed"),
        "most_speed": ("rad/s", "of the motor"),
        "over_speed_time": ("s", "that it may be exceeded"),
        "position_margin": ("rad", "beyond the joint's limits"),
        "volt_per_rate": ("V s/rad", "the motor's back-EMF"),
        "nominal_supply": ("V", "supply voltage"),
        "supply_fall": ("V", "that the supply may be below it"),
        "supply_rise": ("V", "that the supply may be above it"),
        "under_voltage_time": ("s", "that the supply may be lower"),
        "over_voltage_time": ("s", "that the supply may be higher"),
        "spring_error": ("N m", "of torque that accelerates the motor without explanation"),
        "spring_time": ("s", "that it may be exceeded"),
        "heat_step": ("s", "least time between two steps of the thermal model"),
        "resistance": ("Ohm", "of the winding at 25 °C"),
        "winding_heat": ("K/J", "warming of the winding by heat"),
        "winding_rate": ("1/s", "cooling of the winding by the housing"),
        "housing_rate": ("1/s", "warming of the housing by the winding"),
        "housing_share": ("1/s", "cooling of the housing by the air"),
        "permitted_rise": ("K", "of the winding over 25 °C"),
        "temperature_time": ("s", "that it may be exceeded"),
        "continuous_square": ("A²", "square of the current that may flow for ever"),
        "overload_limit": ("A² s", "of the integral of the current's square beyond it"),
        "torque_range": ("N m", "of a command that makes sense"),
        "position_range": ("rad", "of a command that makes sense"),
        "velocity_range": ("rad/s", "of a command that makes sense"),
        "interrupt_time": ("s", "that an interrupt may take"),
        "time_overrun_time": ("s", "that interrupts may take longer"),
    },
    "y": {
        "position": ("1e-6 rad", "of the joint, whole number"),
        "velocity": ("1e-5 rad/s", "of the joint, whole number"),
        "torque": ("1e-4 N m", "on the joint, whole number"),
        "current": ("1e-2 A", "measured, whole number"),
        "motor_velocity": ("1e-3 rad/s", "whole number"),
        "demand": ("counts", "current demand for the power stage, whole number; parameter ampere_per_count"),
        "limited": ("", "1: a limit holds the command or the current back"),
        "torque_si": ("N m", "on the joint"),
        "position_si": ("rad", "of the joint"),
        "trips": ("", "bit by bit what protection has found, whole number"),
        "relaxed_si": ("rad", "where the joint would be if the compliant element were relaxed"),
    },
}

# of states that a block makes for several sensors: by the end of the name
_FAMILIES = {
    "_position": ("rad", "at the last step"),
    "_velocity": ("rad/s", "estimated at the last step"),
    "_before": ("rad", "at the last step"),
    "_start": ("rad", "where the gate of the velocity opened"),
    "_ticks": ("", "steps since the gate of the velocity opened"),
    "_angle": ("rad", "at the last step"),
    "_step": ("rad", "from the step before the last to the last"),
    "_anchor": ("rad", "residual when this encoder last moved"),
    "_timer": ("s", "how long its level has been above the limit"),
}


def quantity(vector: str, name: str) -> Quantity:
    """``name`` of ``vector`` ("counts", "x", "u", "p", "y"). Raises KeyError for one that is not here."""
    known = _GLOSSARY[vector]
    if name in known:
        return Quantity(name, *known[name])
    if vector == "x":
        for ending, entry in _FAMILIES.items():
            if name.endswith(ending):
                return Quantity(name, *entry)
    raise KeyError(f"joint_firmware.export.glossary has no {vector} {name!r}")
