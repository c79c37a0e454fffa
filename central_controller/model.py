"""The controller's rigid-body model: pinocchio, with a floating base and what whole-body control needs each tick.

Generalised coordinates q = [x y z, quaternion x y z w, joints]; velocity = [base linear, base angular (both in the
base's frame), joint rates]: pinocchio's own convention, kept inside this package.

One call of pinocchio fills its own memory. What follows from that is a CasADi expression of it, so that the
controller's tick can be one compiled function that reads pinocchio's memory where it lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
import pinocchio as pin

from central_controller.binding import Bound
from central_controller.rotations import rotation_matrix
from robots.description import Robot

TASKS = ("com_x", "com_z", "pitch", "roll")  # double-support task set (Kim 2018 §5.1.2)
COORDINATES = ("com_x", "com_y", "com_z", "yaw", "pitch", "roll")  # that can be in a set
BASE = 6  # degrees of freedom of the floating base


class Terms(NamedTuple):
    """What whole-body control needs (n = 6 + joints), as CasADi expressions."""

    A: ca.SX  # mass matrix (n, n)
    h: ca.SX  # Coriolis, centrifugal and gravity forces (n,)
    Js: ca.SX  # feet Jacobian (6, n), right foot first, world-aligned
    Jsdot_dq: ca.SX  # its bias acceleration (6,)
    Jt: ca.SX  # Jacobian (tasks, n), by default of TASKS
    Jtdot_dq: ca.SX  # its bias acceleration (tasks,)
    com: ca.SX  # (3,)
    com_velocity: ca.SX  # (3,)
    feet: ca.SX  # positions (3, 2)
    feet_velocity: ca.SX  # (3, 2)
    rpy: ca.SX  # roll, pitch, yaw [rad] of the base (Z-Y-X angles)
    task: ca.SX  # values (tasks,)
    task_velocity: ca.SX  # (tasks,)


class RobotModel:
    """Dynamics and kinematics of a biped with point feet.

    ``compute`` calls pinocchio, which leaves its results in ``sources``; ``terms`` builds from symbols of the same
    names and shapes (``symbols``) what whole-body control needs. ``update`` does both, for use outside the tick: it
    sets an attribute of the name of each of Terms, ``feet`` as (2, 3).
    """

    A: np.ndarray
    h: np.ndarray
    Js: np.ndarray
    Jsdot_dq: np.ndarray
    Jt: np.ndarray
    Jtdot_dq: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    feet: np.ndarray
    rpy: np.ndarray
    task: np.ndarray
    task_velocity: np.ndarray

    def __init__(self, robot: Robot, tasks: Sequence[str] = TASKS) -> None:
        self._tasks = tuple(tasks)  # of ``update``
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
        self._feet = [(foot.name, ids[foot.joint], foot.position) for foot in robot.feet]
        self._gravity = ca.DM([0.0, 0.0, -robot.gravity])
        self.model.gravity.linear = np.array([0.0, 0.0, -robot.gravity])
        self.data = self.model.createData()
        self.nq, self.nv = self.model.nq, self.model.nv
        self.sources = self._sources()
        self._offline: Bound | None = None

    def compute(self, q: np.ndarray, v: np.ndarray) -> None:
        """Fill ``sources`` at coordinates ``q`` (nq,) and velocity ``v`` (nv,)."""
        pin.computeAllTerms(self.model, self.data, q, v)

    def _sources(self) -> dict[str, np.ndarray]:
        """Views of pinocchio's memory, which stays where it is as long as its data live."""
        data = self.data
        views = {
            "M": data.M,  # its upper triangle
            "nle": data.nle,
            "J": data.J,  # joint Jacobians at the world's origin: linear rows, then angular
            "Jcom": data.Jcom,
            "com_0": data.com[0],
            "vcom_0": data.vcom[0],
        }
        for name, joint, _ in self._feet:
            views |= {
                f"{name}_rotation": data.oMi[joint].rotation,
                f"{name}_translation": data.oMi[joint].translation,
                f"{name}_v": data.v[joint].np,  # in the joint's frame: linear, then angular
                f"{name}_a_gf": data.a_gf[joint].np,  # at zero joint accelerations, less gravity; likewise
            }
        assert not any(view.flags.owndata for view in views.values()), "pinocchio returned a copy"
        return views

    def symbols(self) -> dict[str, ca.SX]:
        """A symbol for each of ``sources``."""
        return {name: ca.SX.sym(name, *view.shape) for name, view in self.sources.items()}

    def terms(
        self, sources: dict[str, ca.SX], quaternion: ca.SX, rate: ca.SX, tasks: Sequence[str] = TASKS
    ) -> Terms:
        """What whole-body control of ``tasks`` (of COORDINATES) needs, from pinocchio's results, the base's orientation
        and its angular velocity in its own frame."""
        A, h = ca.triu2symm(ca.triu(sources["M"])), sources["nle"]
        rotation = rotation_matrix(quaternion)
        feet, velocities, jacobians, biases = zip(
            *(self._foot(sources, name, joint, ca.DM(position)) for name, joint, position in self._feet), strict=True
        )
        # h's first rows are what it takes to accelerate the whole by its bias, against gravity
        com, com_velocity, Jcom = sources["com_0"], sources["vcom_0"], sources["Jcom"]
        com_bias = rotation @ h[:3] / A[0, 0] + self._gravity
        rpy, rates, rows, bias = _orientation(rotation, rate)
        pad = ca.SX(1, self.nv - BASE)
        jacobian = dict(zip(COORDINATES, [
            *(Jcom[i, :] for i in range(3)), *(ca.horzcat(ca.SX(1, 3), row, pad) for row in rows)
        ], strict=True))  # fmt: skip
        biases_of = dict(zip(COORDINATES, [*ca.vertsplit(com_bias), *bias], strict=True))
        value = dict(zip(COORDINATES, [*ca.vertsplit(com), rpy[2], rpy[1], rpy[0]], strict=True))
        speed = dict(zip(COORDINATES, [*ca.vertsplit(com_velocity), *rates], strict=True))
        return Terms(
            A=A,
            h=h,
            Js=ca.vertcat(*jacobians),
            Jsdot_dq=ca.vertcat(*biases),
            Jt=ca.vertcat(*(jacobian[task] for task in tasks)),
            Jtdot_dq=ca.vertcat(*(biases_of[task] for task in tasks)),
            com=com,
            com_velocity=com_velocity,
            feet=ca.horzcat(*feet),
            feet_velocity=ca.horzcat(*velocities),
            rpy=rpy,
            task=ca.vertcat(*(value[task] for task in tasks)),
            task_velocity=ca.vertcat(*(speed[task] for task in tasks)),
        )

    def leg(self, foot: int) -> list[int]:
        """Numbers of the joints between the base and a foot."""
        _, joint, _ = self._feet[foot]
        supports = list(self.model.supports[joint])[2:]  # without the universe and the base
        return [self.model.joints[support].idx_v - BASE for support in supports]

    def _foot(
        self, sources: dict[str, ca.SX], name: str, joint: int, lever: ca.DM
    ) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Position, velocity, Jacobian (3, n) and bias acceleration of a foot, in the world's axes."""
        rotation, v, a = (sources[f"{name}_{what}"] for what in ("rotation", "v", "a_gf"))
        position = sources[f"{name}_translation"] + rotation @ lever
        velocity = v[:3] + ca.cross(v[3:], lever)
        # classical acceleration; pinocchio's a_gf has gravity taken off
        bias = a[:3] + ca.cross(a[3:], lever) + ca.cross(v[3:], velocity)
        J = sources["J"]
        columns = [ca.SX(3, 1)] * self.nv
        for support in list(self.model.supports[joint])[1:]:
            first = self.model.joints[support].idx_v
            for i in range(first, first + self.model.joints[support].nv):
                columns[i] = J[:3, i] + ca.cross(J[3:, i], position)
        return position, rotation @ velocity, ca.horzcat(*columns), rotation @ bias + self._gravity

    def update(self, q: np.ndarray, v: np.ndarray) -> None:
        """Compute all attributes at coordinates ``q`` (nq,) and velocity ``v`` (nv,)."""
        if self._offline is None:
            self._offline = self._bind_terms()
        self._q[:], self._v[:] = q, v
        self.compute(self._q, self._v)
        self._offline()

    def _bind_terms(self) -> Bound:
        symbols = {"q": ca.SX.sym("q", self.nq), "v": ca.SX.sym("v", self.nv), **self.symbols()}
        terms = self.terms(symbols, symbols["q"][3:7], symbols["v"][3:6], self._tasks)._asdict()
        function = ca.Function(
            "terms", list(symbols.values()), [ca.densify(t) for t in terms.values()], list(symbols), list(terms)
        )
        self._q, self._v = np.zeros(self.nq), np.zeros(self.nv)
        out = {name: np.zeros(term.shape, order="F") for name, term in terms.items()}
        for name, array in out.items():
            setattr(self, name, array.ravel(order="K") if array.shape[1] == 1 else array)
        self.feet = out["feet"].T
        return Bound(function, {"q": self._q, "v": self._v, **self.sources}, out)


def _orientation(rotation: ca.SX, rate: ca.SX) -> tuple[ca.SX, tuple, tuple, tuple]:
    """Z-Y-X angles; of yaw, pitch and roll: rates, rows of the Jacobian, biases, from the angular velocity ``rate`` in
    the base's frame."""
    roll = ca.atan2(rotation[2, 1], rotation[2, 2])
    pitch = ca.asin(ca.fmax(-1.0, ca.fmin(1.0, -rotation[2, 0])))
    yaw = ca.atan2(rotation[1, 0], rotation[0, 0])
    s, c, tangent = ca.sin(roll), ca.cos(roll), ca.tan(pitch)
    p, q, r = rate[0], rate[1], rate[2]
    turn = q * s + r * c  # yaw rate times cos(pitch)
    pitch_rate, roll_rate = q * c - r * s, p + tangent * turn
    upright = ca.cos(pitch)
    rows = (
        ca.horzcat(0.0, s / upright, c / upright), ca.horzcat(0.0, c, -s), ca.horzcat(1.0, tangent * s, tangent * c)
    )  # fmt: skip
    yaw_bias = (pitch_rate * roll_rate + turn * tangent * pitch_rate) / upright
    biases = (
        yaw_bias, -roll_rate * turn, pitch_rate * turn / upright**2 + tangent * roll_rate * pitch_rate
    )  # fmt: skip
    return ca.vertcat(roll, pitch, yaw), (turn / upright, pitch_rate, roll_rate), rows, biases
