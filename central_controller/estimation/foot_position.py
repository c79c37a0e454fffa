"""Position of a foot from encoders, which are biased and know no bending, and from motion capture, which is often
occluded (Kim 2018 §6.2): four filters of one interface.

| filter              | state               | prediction                          |            |
| ConfigurationFilter | [q, q̇]              | dynamics                            | (6.26–6.30) |
| EndEffectorFilter   | [q, q̇, p]           | dynamics, p + J q̇ Δt                | (6.31–6.34) |
| UnscentedFilter     | [q, q̇, p]           | the same, without linearisation     | Fig. 6.4   |
| LightFilter         | [q̇, p]              | q̇ stays, p + J q̇ Δt                 | (6.35–6.37) |

The third row of (6.32) prints dots over p, and (6.37) leaves out the Δt of J Δt: read as (6.36) says. All adjust the
uncertainty on line: while motion capture does not see the foot, or has nothing new (480 Hz), its variance is huge.
"""

from __future__ import annotations

from collections.abc import Callable

from central_controller.estimation.foot_extended import ConfigurationFilter, EndEffectorFilter
from central_controller.estimation.foot_light import LightFilter
from central_controller.estimation.foot_models import FootFilter
from central_controller.estimation.foot_unscented import UnscentedFilter

FILTERS: dict[str, Callable[..., FootFilter]] = {
    "EKF, configuration": ConfigurationFilter,
    "EKF, end effector": EndEffectorFilter,
    "UKF, end effector": UnscentedFilter,
    "light (Hume)": LightFilter,
}
