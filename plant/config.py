"""Configuration of the physical world."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from robots.quantities import (
    Config,
    Gain,
    Hertz,
    Kelvins,
    Kilograms,
    Metres,
    Newtons,
    Probability,
    Radians,
    RadiansPerSecond,
    Seconds,
    SignedNewtonMetres,
    TorquePerRadian,
    TorquePerRate,
)
from robots.terrain import Block


class TerrainConfig(Config):
    """Ground under the feet. ``split``: panels that face each other, one per foot (Kim 2018 Fig. 5.3)."""

    kind: Literal["flat", "split"] = "flat"
    panel_angle: Annotated[Radians, Field(ge=0, lt=1.4)] = 0.0  # of each panel from the horizontal
    friction: Gain = 0.6  # Coulomb coefficient; rubber on wood panels
    blocks: tuple[Block, ...] = ()  # on flat ground


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
    lock_x: bool = False  # its slider is locked where the robot starts (Kim 2018 §2.2.1)


class HoistConfig(Config):
    """Supports the torso while the drives start, then lowers it."""

    hold: Seconds = 1.0
    release: Seconds = 0.5  # linear, from full support to none


class SensorConfig(Config):
    """Scales on the sensor errors of the robot's description, and how its absolute encoders are mounted."""

    noise: Gain = 1.0  # all noise densities
    bias: Gain = 1.0  # all biases
    mounting: Annotated[Radians, Field(ge=0)] = 0.0  # 1σ, of the joints' absolute encoders; 0: all are calibrated
    # by joint, in place of what ``mounting`` draws: what its absolute encoder reads at 0 rad
    encoder_offset: dict[str, Radians] = Field(default_factory=dict)
    # The gyro's bias wanders beside ``bias``: 1σ of a first-order Gauss-Markov process per axis. Hume's IMU is one of
    # 0.25 deg/s, and drifted faster than that (Kim 2018 §7.3.3).
    gyro_drift: Annotated[RadiansPerSecond, Field(ge=0)] = 0.0
    gyro_drift_time: Annotated[Seconds, Field(gt=0)] = 30.0  # its correlation time, ASSUMED


class MotionCaptureConfig(Config):
    """The motion capture system, and what hides LEDs from it. All but ``enabled`` can be injected while a run goes on.

    Each LED is hidden and seen again by a Markov chain of its own that steps at every exposure.
    """

    enabled: bool = False
    occluded: bool = Field(default=False, description="somebody stands in the way: no LED is seen")
    occlusion: Probability = Field(default=0.0, description="share of the time that each LED is hidden; 0: never")
    occlusion_time: Annotated[Seconds, Field(ge=0, le=100)] = Field(
        default=0.1, description="how long an LED stays hidden in the mean"
    )


class PushConfig(Config):
    """A force on the torso's centre of mass, trapezoidal in time, in the world frame."""

    at: Seconds
    duration: Seconds  # full force
    ramp: Seconds = 0.0  # on either side of it
    force: tuple[Newtons, Newtons, Newtons]


Sensor = Literal["ok", "stuck", "jump", "slip", "noisy", "dead"]
CurrentSensor = Literal["ok", "stuck", "jump", "noisy", "dead"]


class JointFaults(Config):
    """What is wrong with one joint.

    All can also be injected while a run goes on: their descriptions, units, bounds and defaults are what
    ``hil inject --list`` shows. A sensor is ``stuck`` at its last reading, has made a ``jump`` (encoders 0.1 rad,
    current 2.5 times its limit), ``slip`` loses every other count, ``noisy`` is a σ of 5 mrad or of half of the limit,
    ``dead`` reads 0. All but ``command`` act in the plant.
    """

    encoder: Sensor = Field(default="ok", description="incremental encoder of the motor")
    spring_encoder: Sensor = Field(default="ok", description="encoder of the spring's deflection")
    joint_encoder: Sensor = Field(default="ok", description="absolute encoder of the joint")
    current_sensor: CurrentSensor = Field(default="ok", description="current that the drive measures")
    heating: Annotated[Kelvins, Field(ge=-200, le=500)] = Field(
        default=0.0, description="added to what the winding's temperature sensor says"
    )
    supply: Annotated[float, Field(ge=0, le=2)] = Field(default=1.0, description="supply voltage, of the nominal one")
    spring: Annotated[float, Field(ge=0, le=10)] = Field(
        default=1.0, description="stiffness and damping of the spring, of its own; 0: broken"
    )
    friction: Annotated[float, Field(ge=0, le=100)] = Field(
        default=1.0, description="dry friction of the actuator, of its own"
    )
    load: Annotated[SignedNewtonMetres, Field(ge=-2000, le=2000)] = Field(
        default=0.0, description="torque on the joint from outside: somebody hits or holds the leg"
    )
    isr_time: Annotated[Seconds, Field(ge=0, le=1)] = Field(
        default=0.0, description="what each interrupt of its drive takes, by the drive's own timer; 0: what it takes"
    )
    command: Literal["ok", "not_a_number", "out_of_range"] = Field(
        default="ok", description="its set-point in the command frames: -2^31 counts, or 100 kN m"
    )


# kg m², what turns with a knee above the tube of a shank that bends: fork and output stage. ASSUMED: 0.8 kg at 35 mm
SHANK_FORK_INERTIA = 1e-3


class WorldConfig(Config):
    """Physics and the robot in it.

    ``shank_stiffness``: bending of the shanks, fore and aft and sideways, as a hinge with a torsional spring at the top
    of each; 0: rigid. A cantilever of length L that is loaded at its end deflects there as one with 3 E I / L. ASSUMED
    for Hume: a carbon tube of 30 mm with walls of 1.5 mm (0.1 kg of the shank's 0.2 kg) and 80 GPa along the tube,
    E I = 80 GPa · π/64 (30⁴ − 27⁴) mm⁴ = 1.1 kN m²: 7.0 kN m/rad with L = 0.47 m. The 5 cm between motion capture and
    kinematics of Kim 2018 §6.2 would take 560 N m/rad under its 60 N m: most of it must bend elsewhere.
    """

    rate: Hertz = 3000.0  # physics steps per second; a multiple of the firmware's rate
    variant: str | None = None  # another set of masses than the robot's description
    friction_scale: Gain = 1.0  # on the dry friction of the actuators
    mass_error: Annotated[float, Field(ge=-0.9, le=10)] = 0.0  # of all links, relative; inertias with their masses
    shank_stiffness: TorquePerRadian = 0.0
    planarizer: PlanarizerConfig = PlanarizerConfig()
    hoist: HoistConfig = HoistConfig()
