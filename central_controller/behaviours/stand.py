"""Standing on both feet: the centre of mass on a path, the torso upright, an internal force between the feet."""

from __future__ import annotations

from typing import Any

import numpy as np

from bus import messages
from bus.messages import GainSet, Mode
from central_controller.behaviours.behaviour import Compile, Phase, Setpoints, Workspace, ramp
from central_controller.binding import Bound
from central_controller.estimator import filter_constants
from central_controller.law import control, memory_size
from central_controller.path import path_constants
from central_controller.tasks import task_gains
from robots.description import Robot


class Stand:
    """Whole-body control in double support (Kim 2018 §5.1.2)."""

    def __init__(self, workspace: Workspace, compile: Compile) -> None:
        config, model = workspace.config, workspace.model
        self._config = config
        self._counts = workspace.counts
        self._n = n = len(workspace.robot.joints)
        self.telemetry = np.zeros(len(self.fields(workspace.robot)))
        self.torque = self.telemetry[15 : 15 + n]
        self.memory, self.memory_next = np.zeros(memory_size(n)), np.zeros(memory_size(n))
        self.setpoints = Setpoints(n, Mode.TORQUE, GainSet.STANCE)
        self.gains = task_gains(config.tasks, 1.0 / config.rate)
        self.start = np.zeros(2)  # centre of mass x, z when it began to stand
        self._held = np.zeros(n)  # torques then
        self._schedule = np.zeros(4)
        gain = config.internal_force.gain if config.internal_force.feedback else 0.0
        inputs = {
            **model.sources, "counts": workspace.counts, "memory": self.memory, "q": workspace.q, "v": workspace.v,
            "start": self.start, "held": self._held, "schedule": self._schedule,
            "gains": self.gains, "path": path_constants(config.path), "filters": filter_constants(config),
            "internal_force": np.array([config.internal_force.reference, gain]),
        }  # fmt: skip
        outputs = {"telemetry": self.telemetry, "memory_next": self.memory_next}
        self._control = Bound(compile(control(model)), inputs, outputs)

    @staticmethod
    def fields(robot: Robot) -> list[str]:
        """Names of ``telemetry``, in order."""
        names = [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
        names += ["com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference"]
        names += ["internal_force", "internal_force_reference"]
        of_joints = ("torque_command", "torque_sensed", "q", "dq")
        return names + [f"{what}.{j}" for what in of_joints for j in robot.joint_names]

    def act(self, phase: Phase, now_ns: int, since_ns: int) -> None:
        schedule = self._schedule
        if phase is Phase.ON:  # the path begins no earlier, or its reference would jump
            schedule[1:3] = 1.0
            schedule[3] = now_ns * 1e-9 - max(self._config.path.start, since_ns * 1e-9)
        elif phase is Phase.RAMP:
            schedule[2] = ramp(self._config.weight_ramp, self._config.rate, now_ns - since_ns)
        self._control()

    def take_over(self) -> None:
        self.start[:] = self.telemetry[0:3:2]
        self._held[:] = self._counts[2 * self._n :] * messages.NEWTON_METRE
        self._schedule[0] = 1.0

    _ARRAYS = ("telemetry", "start", "_held", "_schedule")  # all else is computed anew

    def snapshot(self) -> Any:
        return [getattr(self, name).copy() for name in self._ARRAYS]

    def restore(self, state: Any) -> None:
        for name, value in zip(self._ARRAYS, state, strict=True):
            getattr(self, name)[:] = value  # in place: the compiled functions are bound to the arrays
