"""The controller's rigid-body model: pinocchio, with a floating base and what whole-body control needs each tick.

Generalised coordinates q = [x y z, quaternion x y z w, joints]; velocity = [base linear, base angular (both in the
base's frame), joint rates]: pinocchio's own convention, kept inside this package.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from robots.description import Robot

TASKS = ("com_x", "com_z", "pitch", "roll")  # double-support task set (Kim 2018 §5.1.2)


class RobotModel:
    """Dynamics and kinematics of a biped with point feet, updated in place.

    Attributes after ``update`` (n = 6 + joints):
        A: mass matrix (n, n). h: Coriolis, centrifugal and gravity forces (n,).
        Js: feet Jacobian (6, n), right foot first, world-aligned. Jsdot_dq: its bias acceleration (6,).
        Jt: Jacobian (4, n) of TASKS. Jtdot_dq: its bias acceleration (4,).
        com, com_velocity: (3,). feet: positions (2, 3). rpy: roll, pitch, yaw [rad] of the base (Z-Y-X angles).
        task, task_velocity: values and rates (4,) of TASKS.
    """

    def __init__(self, robot: Robot) -> None:
        self.model = pin.Model()
        ids = {robot.base.name: self.model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")}
        links = [(robot.base.name, robot.base), *((joint.name, joint.link) for joint in robot.joints)]
        for joint in robot.joints:
            ids[joint.name] = self.model.addJoint(
                ids[joint.parent],
                pin.JointModelRevoluteUnaligned(np.array(joint.axis)),
                pin.SE3(np.eye(3), np.array(joint.position)),
                joint.name,
            )
        for name, link in links:
            inertia = pin.Inertia(link.mass, np.array(link.com), np.diag(link.inertia))
            self.model.appendBodyToJoint(ids[name], inertia, pin.SE3.Identity())
        self._feet = [
            self.model.addFrame(
                pin.Frame(foot.name, ids[foot.joint], pin.SE3(np.eye(3), np.array(foot.position)), pin.FrameType.OP_FRAME)
            )
            for foot in robot.feet
        ]
        self.model.gravity.linear = np.array([0.0, 0.0, -robot.gravity])
        self.data = self.model.createData()
        self.nq, self.nv = self.model.nq, self.model.nv
        n = self.nv
        self._zero = np.zeros(n)
        self._lower = np.tril_indices(n, -1)
        # column-major, as the generated code reads them
        self.A = np.zeros((n, n), order="F")
        self.h = np.zeros(n)
        self.Js = np.zeros((6, n), order="F")
        self.Jsdot_dq = np.zeros(6)
        self.Jt = np.zeros((4, n), order="F")
        self.Jtdot_dq = np.zeros(4)
        self.com, self.com_velocity = np.zeros(3), np.zeros(3)
        self.feet = np.zeros((2, 3))
        self.rpy = np.zeros(3)
        self.task, self.task_velocity = np.zeros(4), np.zeros(4)

    def feet_motion(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (2, 3) and velocities (2, 3) of the feet in the world frame, kinematics only."""
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, q, v)
        positions, velocities = np.empty((2, 3)), np.empty((2, 3))
        for i, frame in enumerate(self._feet):
            positions[i] = pin.updateFramePlacement(model, data, frame).translation
            velocities[i] = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
        return positions, velocities

    def update(self, q: np.ndarray, v: np.ndarray) -> None:
        """Compute all attributes at coordinates ``q`` (nq,) and velocity ``v`` (nv,)."""
        model, data = self.model, self.data
        self.A[:] = pin.crba(model, data, q)
        self.A[self._lower] = self.A.T[self._lower]
        self.h[:] = pin.nonLinearEffects(model, data, q, v)
        # nonLinearEffects overwrites accelerations with gravity in them: bias accelerations need them without
        pin.forwardKinematics(model, data, q, v, self._zero)
        pin.computeJointJacobians(model, data)
        for i, frame in enumerate(self._feet):
            self.feet[i] = pin.updateFramePlacement(model, data, frame).translation
            self.Js[3 * i : 3 * i + 3] = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
            self.Jsdot_dq[3 * i : 3 * i + 3] = pin.getFrameClassicalAcceleration(
                model, data, frame, pin.LOCAL_WORLD_ALIGNED
            ).linear
        pin.centerOfMass(model, data, pin.ACCELERATION, False)
        jacobian = pin.jacobianCenterOfMass(model, data, False)
        self.com[:], self.com_velocity[:] = data.com[0], data.vcom[0]
        bias = data.acom[0]
        self.Jt[0], self.Jt[1] = jacobian[0], jacobian[2]
        self.Jtdot_dq[0], self.Jtdot_dq[1] = bias[0], bias[2]
        self._orientation(data.oMi[1].rotation, v[3:6])
        self.task[:] = self.com[0], self.com[2], self.rpy[1], self.rpy[0]

    def _orientation(self, rotation: np.ndarray, rate: np.ndarray) -> None:
        """Rows of pitch and roll: rates of the Z-Y-X angles from the angular velocity in the base's frame."""
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
        pitch = math.asin(max(-1.0, min(1.0, -rotation[2, 0])))
        self.rpy[:] = roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])
        s, c, tangent = math.sin(roll), math.cos(roll), math.tan(pitch)
        p, q, r = float(rate[0]), float(rate[1]), float(rate[2])
        pitch_row, roll_row = self.Jt[2], self.Jt[3]
        pitch_row[4], pitch_row[5] = c, -s
        roll_row[3], roll_row[4], roll_row[5] = 1.0, tangent * s, tangent * c
        turn = q * s + r * c  # yaw rate times cos(pitch)
        pitch_rate = q * c - r * s
        roll_rate = p + tangent * turn
        self.Jtdot_dq[2] = -roll_rate * turn
        self.Jtdot_dq[3] = pitch_rate * turn / math.cos(pitch) ** 2 + tangent * roll_rate * pitch_rate
        velocity = self.com_velocity
        self.task_velocity[:] = velocity[0], velocity[2], pitch_rate, roll_rate
