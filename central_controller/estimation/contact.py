"""Which feet press on the ground, felt in the joints' torques: beside, or in place of, switches under the feet.

The rows of a leg's joints in A v̇ + h + Jᵀ F = Uᵀ τ (Kim 2018 (2.4); F: of the robot on the ground) have nothing of the
other leg's contact in them: with the joints of a leg as many as the components of its foot's force,

    F = J_l⁻ᵀ (τ − h − A v̇)_l

where τ are the springs' torques, which friction of motor and gear is not in. Accelerations are differences of filtered
velocities; τ − h goes through the same filter, two equal poles, so that both are as late and cancel in the swinging
leg: a momentum observer (De Luca and Mattone 2003) with A taken for constant over the filter's time. The base has no
joint: how its origin accelerates, less gravity, is the IMU's to tell,

    f_base = f_imu − ω̇ × r − ω × (ω × r),    (A v̇ + h)_l = (A [f_base; ω̇; q̈])_l + (h − A [Rᵀ (0, 0, g); 0; 0])_l

A foot that strikes the ground decelerates the leg at once, long before the controller has it press: without the term
A v̇ a touch-down is felt as late as the controller loads the foot, 20 ms (docs/examples/contact_detection.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from central_controller.behaviours.behaviour import Workspace
from central_controller.binding import Bound
from central_controller.law import measured
from central_controller.model import BASE, RobotModel
from central_controller.rotations import rotation_matrix
from robots.description import Robot

_SINGULAR = 1e-4  # m³, of det J_l: Hume's leg within a degree of straight


def fields(robot: Robot) -> list[str]:
    """Names of the telemetry, in order: force with which each foot presses down [N], switch, what is believed."""
    return [f"{what}.{foot.name}" for what in ("foot_press", "foot_switch", "foot_contact") for foot in robot.feet]


def _memory(joints: int) -> int:
    """How many signals are filtered."""
    return 6 + 2 * joints


def ground_forces(model: RobotModel, robot: Robot) -> ca.Function:
    """Inputs: counts (joints, 3), q, v, pinocchio's results (RobotModel.sources), zero (of the gyro), gyro [rad/s],
    force (specific, of the IMU) [m/s²], memory (6 + 2 joints, 2: after each pole of the filter), blend (share of a new
    sample), rate [Hz].
    Outputs: forces (3, feet) of the robot on the ground [N], world's axes; determinants (feet) of the legs' Jacobians
    [m³]; memory_next.

    Filtered are: angular velocity of the base, joint velocities, τ − h of the joints with gravity left out of h, and
    the base's specific force in its own axes. Raises ValueError for a leg that has not three joints.
    """
    joints = model.nv - BASE
    inputs = {
        "counts": ca.SX.sym("counts", joints, 3), "q": ca.SX.sym("q", model.nq), "v": ca.SX.sym("v", model.nv),
        **model.symbols(),
        "zero": ca.SX.sym("zero", 3), "gyro": ca.SX.sym("gyro", 3), "force": ca.SX.sym("force", 3),
        "memory": ca.SX.sym("memory", _memory(joints), 2), "blend": ca.SX.sym("blend"), "rate": ca.SX.sym("rate"),
    }  # fmt: skip
    terms = model.terms(inputs, inputs["q"][3:7], inputs["v"][3:6])
    _, velocity, torque = measured(inputs["counts"])
    spin = inputs["gyro"] - inputs["zero"]
    lever = ca.DM(robot.imu.position) if robot.imu is not None else ca.DM.zeros(3)
    weight = rotation_matrix(inputs["q"][3:7]).T @ ca.DM([0.0, 0.0, robot.gravity])
    resting = terms.h[BASE:] - terms.A[BASE:, :3] @ weight  # h without gravity

    sample = ca.vertcat(spin, velocity, torque - resting, inputs["force"] - ca.cross(spin, ca.cross(spin, lever)))
    first = inputs["memory"][:, 0] + inputs["blend"] * (sample - inputs["memory"][:, 0])
    second = inputs["memory"][:, 1] + inputs["blend"] * (first - inputs["memory"][:, 1])
    speeds = slice(0, 3 + joints)
    acceleration = (second[speeds] - inputs["memory"][speeds, 1]) * inputs["rate"]
    _, sensed, specific = ca.vertsplit(second, [0, 3 + joints, 3 + 2 * joints, 6 + 2 * joints])
    motion = ca.vertcat(specific - ca.cross(acceleration[:3], lever), acceleration)
    residual = sensed - terms.A[BASE:, :] @ motion

    forces, determinants = [], []
    for foot in range(len(robot.feet)):
        leg = model.leg(foot)
        if len(leg) != 3:
            name = robot.feet[foot].name
            raise ValueError(f"{robot.name}: {name} is at a leg of {len(leg)} joints; three tell the force at a foot")
        jacobian = terms.Js[3 * foot : 3 * foot + 3, [BASE + joint for joint in leg]]
        size = ca.det(jacobian)
        determinants.append(size)
        away = ca.if_else(ca.fabs(size) < _SINGULAR, _SINGULAR, size)
        forces.append(ca.adj(jacobian).T @ residual[leg] / away)
    return ca.Function(
        "ground_forces", list(inputs.values()),
        [ca.densify(ca.horzcat(*forces)), ca.vertcat(*determinants), ca.horzcat(first, second)],
        list(inputs), ["forces", "determinants", "memory_next"],
    )  # fmt: skip


class Contact:
    """Tells which feet are in contact, by the force that they press with, with hysteresis, or by that and the switch.

    ``telemetry`` has the meanings of ``fields``. Where a leg is so straight that its torques tell nothing of the force
    along it, what was believed last stays.
    """

    def __init__(self, workspace: Workspace, zero: np.ndarray, compile: Callable[[ca.Function], ca.Function]) -> None:
        """``zero``: of the gyro [rad/s] (3), which may change."""
        robot, config, model = workspace.robot, workspace.config, workspace.model
        n, self._feet = len(robot.joints), len(robot.feet)
        self._config, self._both = config.contact_force, config.contact == "both"
        self._contacts = workspace.contacts
        self._touching = np.zeros(self._feet)
        self._memory, self._memory_next = (np.zeros((_memory(n), 2), order="F") for _ in range(2))
        self._forces, self._determinants = np.zeros((3, self._feet), order="F"), np.zeros(self._feet)
        self.telemetry = np.zeros(len(fields(robot)))
        blend = -math.expm1(-2.0 * math.pi * config.contact_force.cutoff / config.rate)
        self._feel = Bound(
            compile(ground_forces(model, robot)),
            {
                "counts": workspace.counts, "q": workspace.q, "v": workspace.v, **model.sources, "zero": zero,
                "gyro": workspace.gyro, "force": workspace.force, "memory": self._memory,
                "blend": np.array([blend]), "rate": np.array([config.rate]),
            },
            {"forces": self._forces, "determinants": self._determinants, "memory_next": self._memory_next},
        )  # fmt: skip

    def tell(self) -> None:
        """Once a tick, when model and switches are those of this tick: replace the switches in ``contacts``."""
        self._feel()
        self._memory[:] = self._memory_next
        config, row, feet = self._config, self.telemetry, self._feet
        row[feet : 2 * feet] = self._contacts
        for foot in range(feet):
            press = -self._forces[2, foot]
            row[foot] = press
            if abs(self._determinants[foot]) >= _SINGULAR:
                share = config.release if self._touching[foot] else 1.0
                self._touching[foot] = press > share * config.press
        if self._both:
            self._contacts *= self._touching
        else:
            self._contacts[:] = self._touching
        row[2 * feet :] = self._contacts

    def snapshot(self) -> Any:
        return self._memory.copy(), self._touching.copy(), self.telemetry.copy()

    def restore(self, state: Any) -> None:
        self._memory[:], self._touching[:], self.telemetry[:] = state
