"""Experiments on joints, as the tests of the laboratory make them: smooth sensors and no dry friction by default."""

from __future__ import annotations

from typing import Any

import pytest

from hil.compiled import compile_function
from hil.joint_lab import published
from hil.joint_lab.setup import Setup, Timing
from hil.scenario import load
from plant.bench import Locked
from plant.config import SensorConfig
from robots import description


def _experiment(
    robot: str = "vlca", joint: str = "ankle", law: str = "PD_m", settings: Any = (), **changes: Any
) -> Setup:
    described = description.load(robot)
    index = described.joint_names.index(joint)
    firmware = load("stand", [*published.settings(described.joints[index]), f"firmware.law={law}", *settings]).firmware
    timing = Timing(firmware.report_rate, 20 * firmware.rate, 270e-6, 200e-6)
    setup = Setup(
        described, index, firmware, Locked(), SensorConfig(noise=0, bias=0), timing, friction_scale=0.0,
        compile=compile_function,
    )  # fmt: skip
    return setup._replace(**changes)


@pytest.fixture(scope="session")
def experiment() -> Any:
    """``experiment(robot, joint, law, settings, **changes)``: a Setup with the published gains."""
    return _experiment
