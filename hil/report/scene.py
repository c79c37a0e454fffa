"""The model of a scenario's robot on its terrain, to be looked at: a record holds its coordinates only."""

from __future__ import annotations

from typing import Any

from hil.scenario import Scenario
from robots import description


def scene_of(scenario: Scenario) -> Any:
    """The MuJoCo model (``mujoco.MjModel``) that a run of ``scenario`` has: its ``qpos.*`` are this model's.

    Raises plant.stance.StanceError where the robot cannot stand like that.
    """
    from plant import stance
    from plant.model import build

    robot = description.load(scenario.robot, scenario.world.variant)
    start = stance.initial(robot, scenario.stance)
    return build(robot, start, scenario.terrain, scenario.world.planarizer, scenario.world.rate)
