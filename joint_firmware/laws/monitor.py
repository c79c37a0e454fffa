"""Between sensing and the rest: what the signals say about the drive's health, and what follows for the current.

Each watch is a level, the share of its limit that is used; one that has been above 1 for its time is a trip. The trip
word has bit ``1 << fault`` of ``bus.drive_faults`` for every trip, as long as its cause is there: a level with a
release must first fall below that. Nothing is latched here; that is the drive's state machine. But a trip acts on the
current of the same interrupt, so that what is exported protects by itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca

from bus.drive_faults import DriveFault
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import signals as s
from joint_firmware.laws.block import Block, Offsets, Symbols
from joint_firmware.laws.encoders import EncoderWatch, within
from joint_firmware.laws.heat import HeatWatch
from joint_firmware.protection import OF_BRAKING, REACTIONS, Reaction
from robots import pins
from robots.description import Joint

_CURRENT_BLEND_S = 0.005  # time constant behind which measured and demanded current are compared
_OBSERVER_RATE = 2 * math.pi * 10.0  # rad/s, of the torque that is not explained: below the springs' resonances
_VOLTAGE_SHARE = 0.7  # of the supply, that a demanded current may need to be expected: warm windings need half more
_NEVER = 1e9  # a limit that nothing reaches


class Watch(NamedTuple):
    """A level of ``fault``, and the name of the parameter with the time [s] that it may last (None: not at all)."""

    fault: DriveFault
    level: ca.SX
    time: str | None = None
    release: float = 1.0  # what the level must fall below before the trip goes


class Verdict(NamedTuple):
    """What the monitor says."""

    trips: ca.SX  # trip word
    power_off: ca.SX  # whether there may be no current (0 or 1)
    brake: ca.SX  # whether it may only brake
    levels: ca.SX  # by fault, from number 1 on; 0 where this block does not watch


_TIMED = (
    "motor_encoder", "spring_encoder", "joint_encoder", "encoder_mismatch", "current_sensor", "spring", "under_voltage",
    "over_voltage", "over_current", "over_speed", "over_temperature", "overload", "time_overrun",
)  # fmt: skip


class Monitor(Block):
    def __init__(self) -> None:
        self._encoders, self._heat = EncoderWatch(), HeatWatch()
        self._timers = tuple(f"{name}_timer" for name in _TIMED)
        own = ("current_difference", "momentum")
        self.states = (*self._encoders.states, *self._heat.states, *own, *self._timers)
        self.parameters = (
            *self._encoders.parameters, *self._heat.parameters, "dt", "ampere_per_count", "torque_per_ampere",
            "stiffness", "rotor_inertia", "viscous", "current_blend", "observer_rate", "encoder_time", "most_current",
            "over_current_time", "current_error", "current_error_time", "volt_per_rate", "most_torque",
            "spring_error", "spring_time", "most_speed", "over_speed_time", "position_low", "position_high",
            "position_margin", "nominal_supply", "supply_fall", "supply_rise", "under_voltage_time",
            "over_voltage_time", "temperature_time", "torque_range", "position_range", "velocity_range",
            "interrupt_time", "time_overrun_time",
        )  # fmt: skip

    def values(self, joint: Joint, config: FirmwareConfig, offsets: Offsets) -> dict[str, float]:
        limits, actuator = config.protection, joint.actuator
        electric = actuator.motor is not None
        supply = actuator.supply_voltage
        strongest = actuator.torque_per_ampere * actuator.current_limit
        free_speed = supply / actuator.torque_per_ampere if electric else _NEVER  # N m/A are V s/rad
        return {
            **self._encoders.values(joint, config, offsets),
            **self._heat.values(joint, config, offsets),
            "dt": 1.0 / config.rate,
            "ampere_per_count": actuator.ampere_per_count,
            "torque_per_ampere": actuator.torque_per_ampere,
            "stiffness": actuator.stiffness,
            "rotor_inertia": actuator.rotor_inertia,
            "viscous": actuator.viscous,
            "current_blend": 1.0 - math.exp(-1.0 / (_CURRENT_BLEND_S * config.rate)),
            "observer_rate": config.rate * (1.0 - math.exp(-_OBSERVER_RATE / config.rate)),
            "encoder_time": limits.encoder_time,
            "most_current": limits.over_current * actuator.current_limit,
            "over_current_time": limits.over_current_time,
            "current_error": limits.current_error * actuator.current_limit,
            "current_error_time": limits.current_error_time,
            "volt_per_rate": actuator.torque_per_ampere if electric else 0.0,
            "most_torque": limits.over_torque * config.torque_limit,
            "spring_error": limits.spring_error * strongest if electric else _NEVER,
            "spring_time": limits.spring_time,
            "most_speed": limits.over_speed * free_speed,
            "over_speed_time": limits.over_speed_time,
            "position_low": joint.limits[0],
            "position_high": joint.limits[1],
            "position_margin": limits.position_margin,
            "nominal_supply": supply,
            "supply_fall": max((1.0 - limits.under_voltage) * supply, 1e-3),
            "supply_rise": max((limits.over_voltage - 1.0) * supply, 1e-3),
            "under_voltage_time": limits.under_voltage_time,
            "over_voltage_time": limits.over_voltage_time,
            "temperature_time": limits.temperature_time,
            "torque_range": limits.command_range * config.torque_limit,
            "position_range": max(map(abs, joint.limits)) + math.pi,
            "velocity_range": limits.command_range * free_speed,
            "interrupt_time": limits.time_budget / config.rate,
            "time_overrun_time": limits.time_overrun_time,
        }

    def admit(self, u: ca.SX, p: Symbols) -> tuple[ca.SX, ca.SX]:
        """``u`` with zero for every set-point that is not finite or out of range, and the level of the largest."""
        ranges = {s.U_TORQUE: p.torque_range, s.U_POSITION: p.position_range, s.U_VELOCITY: p.velocity_range}
        shares = {index: ca.fabs(u[index]) / limit for index, limit in ranges.items()}
        sound = [share <= 1.0 for share in shares.values()]  # NaN is not
        admitted = ca.SX(u)
        for index, good in zip(shares, sound, strict=True):
            admitted[index] = ca.if_else(good, u[index], 0.0)
        largest = within(*[ca.if_else(good, share, 2.0) for good, share in zip(sound, shares.values(), strict=True)])
        return admitted, largest

    def watch(
        self, counts: ca.SX, u: ca.SX, command: ca.SX, sensed: s.Sensed, x: Symbols, p: Symbols
    ) -> tuple[Verdict, Symbols]:
        """The verdict, and the states of the next tick. ``command``: the level of the set-points."""
        encoders, encoders_next = self._encoders.watch(counts, sensed, x, p)
        current = counts[pins.CURRENT_ADC] * p.ampere_per_count
        supply = counts[pins.SUPPLY_ADC] * pins.VOLT_PER_COUNT
        heat, heat_next = self._heat.watch(counts, current, x, p)

        demanded = x.demand / p.torque_per_ampere
        difference = x.current_difference + p.current_blend * (current - demanded - x.current_difference)
        needed = p.resistance * ca.fabs(demanded) + p.volt_per_rate * ca.fabs(sensed.motor_velocity)  # V
        driven = needed < _VOLTAGE_SHARE * supply
        # what accelerates the rotor beside current, spring and viscous friction, by its momentum
        momentum = ca.if_else(x.started > 0, x.momentum, p.rotor_inertia * sensed.motor_velocity)
        unexplained = p.observer_rate * (p.rotor_inertia * sensed.motor_velocity - momentum)
        explained = p.torque_per_ampere * current - sensed.effort - p.viscous * sensed.motor_velocity
        beyond = ca.fmax(sensed.position - p.position_high, p.position_low - sensed.position)

        watches = (
            *[Watch(fault, level, time) for fault, level, time in encoders],
            Watch(DriveFault.CURRENT_SENSOR, driven * ca.fabs(difference) / p.current_error, "current_error_time"),
            Watch(DriveFault.SPRING, ca.fabs(unexplained) / p.spring_error, "spring_time"),
            Watch(DriveFault.UNDER_VOLTAGE, (p.nominal_supply - supply) / p.supply_fall, "under_voltage_time", 0.9),
            Watch(DriveFault.OVER_VOLTAGE, (supply - p.nominal_supply) / p.supply_rise, "over_voltage_time", 0.9),
            Watch(DriveFault.OVER_CURRENT, ca.fabs(current) / p.most_current, "over_current_time"),
            Watch(DriveFault.OVER_TORQUE, ca.fabs(sensed.torque) / p.most_torque),
            Watch(DriveFault.OVER_SPEED, ca.fabs(sensed.motor_velocity) / p.most_speed, "over_speed_time"),
            Watch(DriveFault.POSITION_LIMIT, beyond / p.position_margin),
            Watch(DriveFault.OVER_TEMPERATURE, heat.temperature, "temperature_time", 0.9),
            Watch(DriveFault.OVERLOAD, heat.load, "temperature_time", 0.5),
            Watch(DriveFault.COMMAND, command),
            Watch(
                DriveFault.TIME_OVERRUN, 1e-6 * counts[pins.ISR_TIMER] / p.interrupt_time, "time_overrun_time"
            ),
        )  # fmt: skip
        tripped, timers_next = self._judge(watches, x, p)
        own = Symbols(
            current_difference=difference, momentum=momentum + p.dt * (explained + unexplained), **timers_next
        )  # fmt: skip
        x_next = Symbols(**vars(encoders_next), **vars(heat_next), **vars(own))
        levels = {fault: ca.SX(0) for fault in DriveFault if fault}
        for watch in watches:
            levels[watch.fault] = ca.fmax(levels[watch.fault], watch.level)
        return self._react(u, tripped, ca.vertcat(*levels.values())), x_next

    def _judge(
        self, watches: tuple[Watch, ...], x: Symbols, p: Symbols
    ) -> tuple[dict[DriveFault, ca.SX], dict[str, ca.SX]]:
        """By fault whether it has tripped, and the timers of the next tick."""
        tripped: dict[DriveFault, ca.SX] = {}
        timers: dict[str, ca.SX] = {}
        for fault, level, time, release in watches:
            if time is None:
                trip = level > 1.0
            else:
                name = f"{fault.name.lower()}_timer"
                before, long = getattr(x, name), ca.fmax(getattr(p, time), p.dt) - 0.5 * p.dt
                bad = level > (1.0 if release == 1.0 else ca.if_else(before >= long, release, 1.0))
                timers[name] = ca.if_else(bad, before + p.dt, 0)
                trip = timers[name] >= long
            tripped[fault] = ca.logic_or(tripped[fault], trip) if fault in tripped else trip
        return tripped, timers

    def _react(self, u: ca.SX, tripped: dict[DriveFault, ca.SX], levels: ca.SX) -> Verdict:
        """The state machine's choice in this interrupt already: of several faults the lowest number decides."""
        trips, reaction, unable = ca.SX(0), ca.SX(int(Reaction.NONE)), ca.SX(0)
        for fault in sorted(tripped, reverse=True):
            trips += float(1 << fault) * tripped[fault]
            reaction = ca.if_else(tripped[fault], int(REACTIONS[fault]), reaction)
            if fault in OF_BRAKING:
                unable = ca.logic_or(unable, tripped[fault])
        braking = u[s.U_DAMPING_MODE] > 0
        power_off = ca.if_else(braking, unable, reaction == int(Reaction.POWER_OFF))
        return Verdict(trips, power_off, ca.logic_and(ca.logic_not(braking), reaction == int(Reaction.BRAKE)), levels)
