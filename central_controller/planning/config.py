"""Configuration of locomotion planning. Defaults: Kim 2018, Table 7.2 (18 unsupported steps of Hume)."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from robots.quantities import Config, Gain, Kilograms, Metres, MetresPerSecond, Probability, Seconds, TorquePerRate

Positive = Field(gt=0)
NotNegative = Field(ge=0)


class StepTiming(Config):
    """The states of one step, in order (Kim 2018 Fig. 7.15 (a), Table 7.2)."""

    dual_support: Seconds = 0.016
    transition: Seconds = 0.024  # the weight moves onto the new stance leg, or off the old one
    lifting: Annotated[Seconds, Positive] = 0.145
    landing: Annotated[Seconds, Positive] = 0.150
    loading: Seconds = 0.024  # after touch-down, the weight moves onto the foot; not in Table 7.2

    @property
    def step_time(self) -> float:
        """From one change of the stance foot to the next, T of Kim 2018 (4.28): all four states, 0.335 s. With this
        sum, and with none of the partial ones, the printed eigenvalues come out (docs/walking.md)."""
        return self.dual_support + self.transition + self.lifting + self.landing


class ReachConfig(Config):
    """Where the swing foot may be put: a box about the stance foot, within another one about its own hip. Both are
    along the world's axes, y counted outwards: to the left for the left foot."""

    forward: Annotated[Metres, Positive] = 0.35  # before or behind the stance foot
    lateral_min: Metres = 0.10  # from the stance foot outwards: the legs do not cross
    lateral_max: Metres = 0.50
    hip_forward: Annotated[Metres, Positive] = 0.35  # before or behind the hips
    hip_inward: Metres = 0.15  # from the hip towards the other one
    hip_outward: Metres = 0.25
    hip_half_width: Metres = 0.1397  # of Hume's description

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.lateral_min > self.lateral_max:
            raise ValueError(f"lateral_min ({self.lateral_min:g} m) exceeds lateral_max ({self.lateral_max:g} m)")
        return self


class ExtensionConfig(Config):
    """Longer swing where the feet would come together (Kim 2018 §4.3.2). The centre of mass falls away from the stance
    foot meanwhile, so the step gets wider and faster. ``limit`` 0 switches it off."""

    limit: Seconds = 0.10  # the longest extension of one step
    step_width: Annotated[Metres, NotNegative] = 0.16  # wanted lateral distance of the foot from the stance foot
    lateral_speed: Annotated[MetresPerSecond, NotNegative] = 0.20  # wanted at the switch, outwards


class PlannerConfig(Config):
    """Foot placement by constant time to velocity reversal (Kim 2018 §4.3)."""

    lateral: bool = True  # false: feet are placed in x alone, for a planarizer holds y
    reversal_time_x: Annotated[Seconds, Positive] = 0.185  # t'_x
    reversal_time_y: Annotated[Seconds, Positive] = 0.18  # t'_y
    kappa_x: Gain = 0.4  # pull towards the goal
    kappa_y: Gain = 0.4
    goal_distance: Annotated[Metres, Positive] = 1.0  # a goal further away pulls no more than one at this distance
    lateral_bias: Metres = 0.0  # the foot is put this much further out; 3 to 5 cm alone keep the feet apart
    replan_at: Annotated[float, Field(ge=0, le=1)] = 0.7  # of the lifting state
    integration_step: Annotated[Seconds, Positive] = 0.01
    reach: ReachConfig = ReachConfig()
    extension: ExtensionConfig = ExtensionConfig()
    ramp: Annotated[Metres, Positive] = 0.3  # length over which the centre of mass rises or falls about a block's edge
    edge_clearance: Metres = 0.04  # of a planned foot from a block's edge


class SwingConfig(Config):
    """The swing foot's way."""

    height: Annotated[Metres, Positive] = 0.05  # of the lift, above the higher of the grounds that it joins
    # Of the lifting, before the foot leaves for where a plan made then would put it: 1, at the landing only (§7.3.2)
    depart: Annotated[float, Field(ge=0, le=1)] = 1.0
    level: Annotated[float, Field(ge=0, lt=1)] = 0.0  # share of the landing before it goes down: over an edge
    touchdown_speed: Annotated[MetresPerSecond, NotNegative] = 0.10  # downwards, when the ground is expected
    search_depth: Annotated[Metres, NotNegative] = 0.05  # how far below that a late ground is looked for


_Length = Annotated[Metres, Field(gt=0, le=2)]
_Time = Annotated[Seconds, Field(gt=0, le=10)]


class OpenLoopConfig(Config):
    """Steps whose joint angles are planned beforehand (Kim 2018 §7.1). The right foot starts half a step in front of
    the origin, the left one half a step behind it; the left one swings first."""

    steps: Annotated[int, Field(ge=1, le=20)] = 1
    start: Seconds = 3.0  # of the motion, from the start of the run
    step_length: _Length = 0.3  # between the feet
    com_height: _Length = 0.83  # above the feet's centres, at rest
    apex_speed: Annotated[MetresPerSecond, Field(gt=0, le=2)] = 0.30  # of the centre of mass above each stance foot
    rise: Annotated[Metres, Field(ge=0, le=1)] = 0.01  # h_o of (7.6): of the height's peak above each stance foot
    drop: Annotated[Metres, Field(ge=0, le=1)] = 0.01  # of the height where a foot lands, for a soft landing
    wind_up: Annotated[Metres, Field(ge=0, le=1)] = 0.04  # the centre of mass is moved back by this first
    wind_up_time: _Time = 1.0
    lift_off: _Length = 0.07  # of the centre of mass before the stance foot, at the first lift-off
    push_time: _Time = 0.8  # from rest to the first lift-off
    last_landing: _Length = 0.06  # of the centre of mass behind the last stance foot
    stop_time: _Time = 0.6  # from the last landing to rest
    dual_time: Annotated[Seconds, Field(le=10)] = 0.2  # on both feet between two steps; the weight goes over evenly
    clearance: _Length = 0.06  # of the swing foot above the higher of the grounds that it joins
    boost_speed: Annotated[MetresPerSecond, Field(ge=0, le=2)] = 0.0  # §7.1.6: gained after the first lift-off
    boost_length: _Length = 0.03  # over this way
    slider_mass: Kilograms = 5.0  # m_s of (7.5)
    swing_momentum: bool = True  # the way allows for the angular momentum of the swing leg; false: as in the source
    wait: Seconds = 0.2  # for a foot that should have landed
    feed_forward: Probability = 1.0  # share of the planned torques that the drives are told beside the positions
    drive_damping: TorquePerRate = 0.0  # kd / (1 + kp): drives brake their motors so; the torques make up for it
    settled: Seconds = 0.01  # a foot carries once its switch has been closed for so long

    @model_validator(mode="after")
    def _within_a_step(self) -> Self:
        for key in ("lift_off", "last_landing"):
            if getattr(self, key) >= self.step_length:
                raise ValueError(
                    f"{key} ({getattr(self, key):g} m) must be less than step_length ({self.step_length:g} m)"
                )
        return self
