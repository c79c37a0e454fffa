"""Configuration of locomotion planning. Defaults: Kim 2018, Table 7.2 (18 unsupported steps of Hume)."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from robots.quantities import Config, Gain, Metres, MetresPerSecond, Seconds

Positive = Field(gt=0)
NotNegative = Field(ge=0)


class StepTiming(Config):
    """The states of one step, in order (Kim 2018 Fig. 7.15 (a), Table 7.2)."""

    dual_support: Seconds = 0.016
    transition: Seconds = 0.024  # the weight moves onto the new stance leg, or off the old one
    lifting: Annotated[Seconds, Positive] = 0.145
    landing: Annotated[Seconds, Positive] = 0.150
    loading: Seconds = 0.024  # after touch-down, the weight moves onto the foot

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

    reversal_time_x: Annotated[Seconds, Positive] = 0.185  # t'_x
    reversal_time_y: Annotated[Seconds, Positive] = 0.18  # t'_y
    kappa_x: Gain = 0.4  # pull towards the goal
    kappa_y: Gain = 0.4
    lateral_bias: Metres = 0.0  # the foot is put this much further out; 3 to 5 cm alone keep the feet apart
    replan_at: Annotated[float, Field(ge=0, le=1)] = 0.7  # of the lifting state
    integration_step: Annotated[Seconds, Positive] = 0.01
    reach: ReachConfig = ReachConfig()
    extension: ExtensionConfig = ExtensionConfig()


class SwingConfig(Config):
    """The swing foot's way."""

    height: Annotated[Metres, Positive] = 0.05  # of the lift
    touchdown_speed: Annotated[MetresPerSecond, NotNegative] = 0.10  # downwards, when the ground is expected
    search_depth: Annotated[Metres, NotNegative] = 0.05  # how far below that a late ground is looked for
