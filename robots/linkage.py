"""The slider-crank that turns a prismatic actuator's stroke into a joint's angle (Kim 2018 Fig. 5.8).

The actuator, of length L, is the third side of a triangle whose other two are a crank on the moving link and the base
between the joint and the actuator's foot. By the law of cosines, with phi the angle between crank and base,

    L² = crank² + base² − 2 crank base cos(phi),      phi = q + offset
    dL/dq = crank base sin(phi) / L = N_l, the effective moment arm

Every function takes and gives floats or CasADi expressions, so that plant and firmware share them.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Any, Self

import casadi as ca
from pydantic import Field, model_validator

from robots.quantities import Config

Positive = Annotated[float, Field(gt=0)]


class Linkage(Config):
    """Slider-crank geometry. The moment arm at joint angle ``nominal`` scales the equivalent rotary coordinates."""

    crank: Positive  # m
    base: Positive  # m
    offset: Annotated[float, Field(gt=0, lt=math.pi)]  # rad, between crank and base at q = 0; q opens it
    nominal: float = 0.0  # rad

    @model_validator(mode="after")
    def _closes(self) -> Self:
        if not 0 < self.nominal + self.offset < math.pi:
            raise ValueError(f"nominal = {self.nominal}: the linkage is stretched out or folded there")
        return self

    def length(self, q: Any) -> Any:
        """L(q), m."""
        c, b = self.crank, self.base
        return ca.sqrt(c * c + b * b - 2 * c * b * ca.cos(q + self.offset))

    def arm(self, q: Any) -> Any:
        """N_l(q) = dL/dq, m."""
        return self.crank * self.base * ca.sin(q + self.offset) / self.length(q)

    def angle(self, length: Any) -> Any:
        """q at which the actuator has ``length`` [m], rad; the inverse of ``length``."""
        c, b = self.crank, self.base
        return ca.acos((c * c + b * b - length * length) / (2 * c * b)) - self.offset

    @cached_property
    def nominal_length(self) -> float:
        """L at ``nominal``, m."""
        return float(self.length(self.nominal))

    @cached_property
    def nominal_arm(self) -> float:
        """r0 = N_l at ``nominal``, m: effort = force · r0, phi = (L − L0) / r0."""
        return float(self.arm(self.nominal))

    def motor_coordinate(self, q: Any) -> Any:
        """phi = f(q) = (L(q) − L(q0)) / r0, rad: a rigid drive's motor, in equivalent rotary coordinates."""
        return (self.length(q) - self.nominal_length) / self.nominal_arm

    def joint_angle(self, phi: Any) -> Any:
        """q = f⁻¹(phi), rad."""
        return self.angle(self.nominal_length + self.nominal_arm * phi)

    def ratio(self, q: Any) -> Any:
        """f'(q) = N_l(q) / r0: joint torque per effort, motor velocity per joint velocity (Kim 2018 (5.22))."""
        return self.arm(q) / self.nominal_arm

    def ratio_rate(self, q: Any) -> Any:
        """f''(q), 1/rad: the derivative of ``ratio``."""
        length, sine = self.length(q), ca.sin(q + self.offset)
        product = self.crank * self.base
        return (product * ca.cos(q + self.offset) / length - (product * sine) ** 2 / length**3) / self.nominal_arm
