"""Configuration of the physical world."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from robots.quantities import (
    Config,
    Gain,
    Hertz,
    Kilograms,
    Metres,
    Newtons,
    Radians,
    Seconds,
    TorquePerRadian,
    TorquePerRate,
)


class TerrainConfig(Config):
    """Ground under the feet. ``split``: panels that face each other, one per foot (Kim 2018 Fig. 5.3)."""

    kind: Literal["flat", "split"] = "flat"
    panel_angle: Annotated[Radians, Field(ge=0, lt=1.4)] = 0.0  # of each panel from the horizontal
    friction: Gain = 0.6  # Coulomb coefficient; rubber on wood panels


class StanceConfig(Config):
    """Where the feet and the hips start. The right foot is in front."""

    feet_apart: Metres = 0.0  # fore and aft
    feet_width: Metres = 0.28  # lateral
    hip_height: Metres = 0.75  # of the hip axes above the midpoint of the feet


class PlanarizerConfig(Config):
    """The linkage that holds the torso in the sagittal plane; its slider is unknown to the controller."""

    enabled: bool = True
    slider_mass: Kilograms = 5.0  # moves with the robot in x (Kim 2018 §5.1.2)
    roll_stiffness: TorquePerRadian = 1500.0  # "slightly flexible"; ASSUMED
    roll_damping: TorquePerRate = 20.0


class HoistConfig(Config):
    """Supports the torso while the drives start, then lowers it."""

    hold: Seconds = 1.0
    release: Seconds = 0.5  # linear, from full support to none


class SensorConfig(Config):
    """Scales on the sensor errors of the robot's description."""

    noise: Gain = 1.0  # all noise densities
    bias: Gain = 1.0  # all biases


class PushConfig(Config):
    """A force on the torso's centre of mass, trapezoidal in time, in the world frame."""

    at: Seconds
    duration: Seconds  # full force
    ramp: Seconds = 0.0  # on either side of it
    force: tuple[Newtons, Newtons, Newtons]


class WorldConfig(Config):
    """Physics and the robot in it."""

    rate: Hertz = 3000.0  # physics steps per second; a multiple of the firmware's rate
    variant: str | None = None  # another set of masses than the robot's description
    friction_scale: Gain = 1.0  # on the dry friction of the actuators
    mass_error: Annotated[float, Field(ge=-0.9, le=10)] = 0.0  # of all links, relative; inertias with their masses
    planarizer: PlanarizerConfig = PlanarizerConfig()
    hoist: HoistConfig = HoistConfig()
